"""Modules in C: their tables become a class, and their methods run as those of one."""

import random
import re
import struct

import numpy as np
import pytest
from c_modules import EXAMPLE, compile_c, write_c

from pbonet.config import Library
from pbonet.errors import (
    DeclarationError,
    MethodError,
    ModuleLoadError,
    ParameterError,
)
from pbonet.modules.controllers.joint_pid import JointPID
from pbonet.pbo import Recovery, Signal, State, TimingFailure, render
from pbonet.ports import Kind
from pbonet.testing import Bench

TALKS = """
#include <string.h>
#include <pbonet.h>

struct talks {
    const double *x;
    const int32_t *n;
    const float *z;
    double *y;
    bool *flag;
    int64_t *count;
    double gain, each[2], list[3];
    int64_t mode;
    bool strict;
    int32_t n_list;
    double told;
};

static const pbo_port ports[] = {
    PBO_IN_CONST(struct talks, n, "N", "1", "none", "a size"),
    PBO_IN_VAR(struct talks, x, "X", "1", "rad", "a number", PBO_MAX_AGE(0.5),
               PBO_STALE("stable"), PBO_FEEDBACK),
    PBO_IN_VAR(struct talks, z, "Z", "n,2", "m", "a matrix"),
    PBO_OUT_VAR(struct talks, y, "Y", "n", "rad", "values", PBO_NEW, PBO_SAFE(1.5)),
    PBO_OUT_VAR(struct talks, flag, "FLAG", "1", "none", "a", PBO_NEW, PBO_SAFE(1)),
    PBO_OUT_VAR(struct talks, count, "COUNT", "1", "none", "b", PBO_NEW, PBO_SAFE(0)),
};
static const pbo_param params[] = {
    PBO_PARAM(struct talks, gain, "none", "a gain", PBO_GE(0), PBO_LT(9), PBO_RATE(2)),
    PBO_PARAM_ARRAY(struct talks, each, "m", "two", PBO_DEFAULT(0.25, 0.75),
                    PBO_TOTAL(1)),
    PBO_PARAM_LIST(struct talks, list, n_list, "s", "some", PBO_DEFAULT(1, 2),
                   PBO_GT(0)),
    PBO_PARAM(struct talks, mode, "none", "a number", PBO_DEFAULT(3), PBO_LE(7)),
    PBO_PARAM(struct talks, strict, "none", "a switch", PBO_DEFAULT(1)),
};

static int init(void *state, pbo_task *task)
{
    struct talks *self = state;
    if (pbo_data(task, "X") != (const void *)self->x || pbo_data(task, "other"))
        return pbo_fail(task, 2, "no data");
    return self->mode == 7 ? pbo_fail(task, 7, "mode %d", (int)self->mode) : PBO_OK;
}

static int on(void *state, pbo_task *task)
{
    struct talks *self = state;
    self->told = (double)task->cyclecount + task->period;
    return *self->x < 0 ? PBO_OFF : PBO_OK;
}

static int cycle(void *state, pbo_task *task)
{
    struct talks *self = state;
    for (int i = 0; i < *self->n; i++)
        self->y[i] = self->gain * *self->x + (double)self->z[2 * i + 1] + task->dt;
    *self->flag = self->strict;
    *self->count = self->n_list;
    if (*self->x == 5)
        pbo_warn(task, 4, "x is %g", *self->x);
    if (*self->x == 6)
        return pbo_fail(task, 9, "x is %g", *self->x);
    if (*self->x == 7)
        return PBO_ERROR;
    if (*self->x == 8)
        pbo_signal(task, PBO_SIGNAL_FINISH);
    for (int i = 0; *self->x == 10 && i < 20; i++)
        pbo_warn(task, 4, "again");
    if (*self->x == 11)
        return 33;
    return PBO_OK;
}

static int stable(void *state, pbo_task *task)
{
    struct talks *self = state;
    (void)task;
    self->y[0] = -1;
    return PBO_OK;
}

static int error(void *state, pbo_task *task)
{
    (void)state;
    if (task->errnum == 9 && strstr(task->errmsg, "x is 6"))
        return PBO_CONTINUE;
    return PBO_ERROR;
}

static int clear(void *state, pbo_task *task)
{
    struct talks *self = state;
    (void)task;
    return *self->x == 7 ? PBO_ERROR : PBO_OFF;
}

static int set(void *state, pbo_task *task, int param)
{
    struct talks *self = state;
    if (param == 3 && self->mode == 5)
        return pbo_fail(task, 5, "five is not for us");
    return PBO_OK;
}

static int timing_failure(void *state, pbo_task *task, int kind)
{
    (void)state;
    (void)task;
    return kind == PBO_DEADLINE ? PBO_ERROR : kind == PBO_MAXEXEC ? PBO_SKIP : PBO_OK;
}

PBO_MODULE(struct talks, "Says what it does.\\n\\nAt length.", PBO_PORTS(ports),
           PBO_PARAMS(params), PBO_CLASS("robot interface"), .init = init, .on = on,
           .cycle = cycle, .stable = stable,
           .error = error, .clear = clear, .set = set,
           .timing_failure = timing_failure);
"""
VALUES = {"n": 2, "x": 1.0, "z": [[1, 2], [3, 4]]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("library")
    write_c(folder, "talks", TALKS)
    compile_c(EXAMPLE / "pid.c", folder / "pid.so")
    return folder


@pytest.fixture
def talks(folder):
    """Put the module on a bench."""
    cls = Library([folder]).load("talks").cls

    def make(values=VALUES, **more):
        return Bench(cls, values, params={"gain": 2.0, **more})

    return make


def test_its_tables_are_a_description(folder):
    info = Library([folder]).load("talks").info
    assert (info.name, info.cls, info.doc) == ("talks", "Talks", "Says what it does.")
    assert info.file == str(folder / "talks.so")
    assert info.methods == (
        *("init", "on", "cycle", "error", "clear", "set", "stable", "timing_failure"),
    )
    assert info.critical_ok
    assert info.robot_interface
    ports = {port.name: port for port in info.ports}
    assert ports["N"].is_size
    assert (ports["N"].attr, ports["N"].type, ports["N"].kind) == (
        *("n", "int32"),
        Kind.INCONST,
    )
    x = ports["X"]
    assert (x.type, x.shape, x.unit, x.doc) == ("float64", (), "rad", "a number")
    assert (x.max_age, x.stale, x.feedback) == (0.5, "stable", True)
    assert (ports["Z"].type, ports["Z"].shape) == ("float32[]", ("n", 2))
    assert (ports["Y"].new, ports["Y"].safe) == (True, (1.5,))
    assert ports["FLAG"].type == "bool"
    params = {one.name: one for one in info.params}
    assert params["gain"].required
    assert params["gain"].bounds == ">= 0 and < 9 and steps <= 2 while ON"
    assert params["each"].type == "2 float"
    assert params["each"].default == "0.25 0.75"
    assert (params["list"].type, params["list"].default) == (
        *("one or more float", "1.0 2.0"),
    )
    assert (params["mode"].type, params["mode"].default) == ("int", "3")
    assert (params["strict"].type, params["strict"].default) == ("bool", "yes")
    assert "talks.so" in render(info)


def test_it_is_listed_by_its_name_and_other_shared_objects_are_not(folder):
    write_c(folder, "helper", "int helper(void);\nint helper(void) { return 1; }\n")
    names = Library([folder]).modules()
    assert {"talks", "pid"} <= set(names)
    assert "helper" not in names
    with pytest.raises(ModuleLoadError, match=r"no module in C.*pbonet_module"):
        Library([folder]).load("helper")


def test_a_folder_has_one_module_of_a_name(folder, tmp_path):
    for name in ("pid.py", "pid.so"):
        (tmp_path / name).write_bytes((folder / "pid.so").read_bytes())
    with pytest.raises(ModuleLoadError, match=r"two modules pid .*pid.py and pid.so"):
        Library([tmp_path]).load("pid")


def test_ports_and_parameters_stand_in_its_struct(talks):
    bench = talks(list=[1.0, 2.0, 3.0], strict=False)
    bench.on()
    bench.step(dt=0.5)
    assert bench.outputs.y.tolist() == [2.0 + 2.0 + 0.5, 2.0 + 4.0 + 0.5]
    assert bench.outputs.flag is False
    assert bench.outputs.count == 3
    assert bench.set("gain", 3.0) == 3.0
    bench.set("list", [4.0])
    bench.step(dt=0.5)
    assert bench.outputs.y[0] == 3.0 + 2.0 + 0.5
    assert bench.outputs.count == 1


def test_a_list_has_no_more_values_than_room(talks):
    with pytest.raises(ParameterError, match=r"too many values .*at most 3.*4 values"):
        talks(list=[1.0, 2.0, 3.0, 4.0])
    bench = talks()
    bench.on()
    with pytest.raises(MethodError, match="too many values"):
        bench.set("list", [1.0, 2.0, 3.0, 4.0])
    bench.step()
    assert bench.outputs.count == 2, "the old values remain"
    with pytest.raises(ParameterError, match="too large"):
        talks(mode=-(2**70))


def test_set_may_refuse_and_the_old_value_remains(talks):
    bench = talks()
    bench.on()
    assert bench.set("mode", 4) == 4
    with pytest.raises(MethodError, match="five is not for us"):
        bench.set("mode", 5)
    assert bench.get("mode") == 4
    assert bench.set("mode", 6) == 6, "it would refuse again if 5 stood there"


def test_methods_answer_as_in_python(talks):
    bench = talks({**VALUES, "x": -1.0})
    assert bench.on() is State.OFF
    bench.inputs.x = 1.0
    assert bench.on() is State.ON
    bench.inputs.x = 7.0
    with pytest.raises(MethodError, match=r"cycle returned PBO_ERROR"):
        bench.step()
    assert bench.state is State.ERROR


def test_clear_may_refuse(talks):
    bench = talks()
    bench.on()
    bench.inputs.x = 7.0
    with pytest.raises(MethodError):
        bench.step()
    assert bench.clear() is State.ERROR


def test_an_error_has_number_and_place_and_error_may_go_on(talks, folder):
    bench = talks()
    bench.on()
    bench.inputs.x = 6.0
    assert bench.step() is State.ON, "error answered PBO_CONTINUE"
    failure = bench.executor.failure
    assert failure is None or failure.number == 9
    assert bench.outputs.y[0] == 2.0 * 6.0 + 2.0 + 0.01, "and the outputs count"
    bench.inputs.x = 11.0
    with pytest.raises(MethodError, match="cycle returned 33"):
        bench.step()
    assert bench.clear() is State.OFF
    with pytest.raises(MethodError, match="mode 7") as caught:
        talks(mode=7)
    line = 1 + TALKS[: TALKS.index('"mode %d"')].count("\n")
    assert caught.value.number == 7
    assert caught.value.place == f"{folder / 'talks.c'}:{line} in init"


def test_warnings_and_signals_leave_when_it_has_returned(talks):
    bench = talks()
    bench.on()
    bench.inputs.x = 5.0
    bench.step()
    bench.inputs.x = 8.0
    bench.step()
    bench.inputs.x = 10.0
    bench.step()
    told = [(one.bits, one.text, one.code) for one in bench.notices()]
    assert told[0] == (Signal.WARNING, "x is 5", 4)
    assert told[1][0] == Signal.FINISH
    assert [text for _, text, _ in told[2:]] == [
        *["again"] * 8,
        "12 more warnings and signals of cycle had no room",
    ]


def test_stable_and_safe_values_run_in_its_place(folder):
    cls = Library([folder]).load("talks").cls
    bench = Bench(cls, VALUES, params={"gain": 2.0}, critical=True)
    bench.on()
    bench.illegal = True
    bench.step()
    assert bench.outputs.y[0] == -1.0
    bench = Bench(cls, VALUES, params={"gain": 2.0}, on_stale="safe")
    bench.on()
    bench.stale = {"x"}
    bench.step()
    assert bench.outputs.y[0] in {1.5, -1.0}


@pytest.mark.parametrize(
    ("kind", "answer"),
    [
        (TimingFailure.DEADLINE, Recovery.ABORT),
        (TimingFailure.MAXEXEC, Recovery.SKIP),
        (TimingFailure.MINEXEC, Recovery.CONTINUE),
    ],
)
def test_its_handler_of_timing_failures_is_told_the_kind(talks, kind, answer):
    bench = talks()
    bench.on()
    assert bench.timing_failure(kind) is answer


def test_the_example_is_its_twin_to_the_last_bit(folder):
    gains = {"kp": 101.3, "ki": 47.7, "kd": 9.9, "limit": 20.0}
    chance = random.Random(7)
    benches = [
        Bench(cls, {"ndof": 6, "tau": [3.3] * 6, "q_ref": [0.01] * 6}, params=gains)
        for cls in (Library([folder]).load("pid").cls, JointPID)
    ]
    for bench in benches:
        bench.on()
    saturated = 0
    for _ in range(300):
        values = {
            name: [chance.uniform(-size, size) for _ in range(6)]
            for name, size in (("q_ref", 0.3), ("q", 0.1), ("qd", 0.5))
        }
        dt = chance.uniform(0.001, 0.01)
        for bench in benches:
            for name, numbers in values.items():
                setattr(bench.inputs, name, numbers)
            bench.step(dt=dt)
        one, other = (bench.outputs.tau.copy() for bench in benches)
        assert one.tobytes() == other.tobytes()
        saturated += int(np.any(np.abs(one) == 20.0))
    assert 0 < saturated < 300


def test_its_shape_may_be_too_large_for_its_room(folder):
    cls = Library([folder]).load("pid").cls
    gains = {"kp": 1.0, "limit": 1.0}
    with pytest.raises(MethodError, match="room for 64 joints, not for 65"):
        Bench(cls, {"ndof": 65}, params=gains)


SMALL = """
#include <pbonet.h>
struct small {{ const int32_t *n; const double *x; double *y; double k; char s[4]; }};
struct other {{ double pad[9]; double k; }};
static const pbo_port ports[] = {{ {ports} }};
static const pbo_param params[] = {{ {params} }};
static int cycle(void *state, pbo_task *task) {{ (void)state; (void)task; return 0; }}
{more}
PBO_MODULE(struct small, "{doc}", PBO_PORTS(ports), PBO_PARAMS(params), {methods});
"""
PARTS = {
    "ports": 'PBO_IN_CONST(struct small, n, "N", "1", "none", "size"), {port}',
    "port": 'PBO_OUT_VAR(struct small, y, "Y", "n", "rad", "value")',
    "params": 'PBO_PARAM(struct small, k, "none", "gain", PBO_DEFAULT(0))',
    "more": "",
    "doc": "Does it.",
    "methods": ".cycle = cycle",
}


def small(**parts):
    texts = {**PARTS, **parts}
    texts["ports"] = texts["ports"].format(port=texts.pop("port"))
    return SMALL.format(**texts)


K = "PBO_PARAM(struct small, k, {})"
TEXT = 'PBO_PARAM_TEXT(struct small, s, "a text", {})'
PORT = 'PBO_OUT_VAR(struct small, y, "{}", "{}", "{}", "{}")'


def own(rows):
    """Return the parts of a module with signals of its own."""
    rows = rows.replace("{", "PBO_USER_SIGNAL(").replace("}", ")")
    return {
        "more": f"static const pbo_user_signal own[] = {{ {rows} }};",
        "methods": ".cycle = cycle, PBO_SIGNALS(own)",
    }


ROW = '{{.field = "y", .name = "Y", .shape = "1", .unit = "m", .doc = "d", {}}}'


@pytest.mark.parametrize(
    ("parts", "what"),
    [
        ({"methods": ".on = cycle"}, r"pbonet_module\.cycle.*no method cycle"),
        (
            {"methods": ".cycle = cycle, .abi = 1"},
            r"pbonet_module\.abi.*built for another pbonet: abi differs .*2.*1",
        ),
        (
            {"methods": ".cycle = cycle, .size = 8"},
            r"pbonet_module\.size.*size differs .*got 8",
        ),
        ({"methods": ".cycle = cycle, .task_size = 9"}, r"task_size differs"),
        ({"methods": ".cycle = cycle, .signal_size = 9"}, r"signal_size differs"),
        ({"methods": '.cycle = cycle, PBO_CLASS("toy")'}, r"pbonet_module.*toy"),
        (
            {"port": PORT.format("Y", "m", "rad", "d")},
            r'bad\.c:\d+, field y.*shape names m, which is no integer constant.*"m"',
        ),
        ({"port": PORT.format("Y", "0", "rad", "d")}, r"field y.*neither a size"),
        (
            {"port": PORT.format("Y Z", "n", "rad", "d")},
            r"field y.*name is not allowed",
        ),
        ({"port": PORT.format("Y", "n", "", "d")}, r"field y.*no unit"),
        (
            {"port": ROW.format(".kind = PBO_OUTVAR, .type = 77, .offset = 16")},
            r"field y.*unknown type",
        ),
        (
            {"port": ROW.format(".kind = 9, .type = PBO_F64, .offset = 16")},
            r"field y.*unknown kind",
        ),
        (
            {"port": ROW.format(".kind = 3, .type = PBO_F64, .offset = 8000")},
            r"field y.*no place of its own.*byte 8000",
        ),
        (
            {"port": ROW.format(".kind = 3, .type = PBO_F64, .offset = 0")},
            r"field [yn].*no place of its own.*the place of [ny]",
        ),
        (
            {"params": 'PBO_PARAM(struct other, k, "none", "gain")'},
            r"field k.*no place of its own",
        ),
        ({"params": K.format('"none", ""')}, r"field k.*no doc"),
        (
            {"params": K.format('"m", "g", PBO_DEFAULT(9), PBO_LE(1)')},
            r"field k.*default is refused",
        ),
        (
            {"params": K.format('"m", "g", PBO_CHOICES("a", "b")')},
            r"field k.*only a text has choices .*PBO_PARAM_TEXT.*float64",
        ),
        (
            {"params": TEXT.format('PBO_TEXT("c"), PBO_CHOICES("a", "b")')},
            r"field s.*default is refused.*no such choice",
        ),
        ({"params": TEXT.format("PBO_GE(1)")}, r"field s.*a str has no bounds"),
        (own('{25, "LATE", "d"}'), r"field LATE.*user signals go from 0 to 24"),
        (own('{1, "late", "d"}'), r"field late.*capital letters"),
        (own('{1, "ERROR", "d"}'), r"field ERROR.*every task has a signal ERROR"),
        (own('{1, "A", "d"}, {1, "B", "d"}'), r"field B.*user signal 1 is A already"),
        (own('{1, "A", "d"}, {2, "A", "d"}'), r"field A.*name A is taken"),
        (
            {"more": "int nowhere(void); int (*at)(void) = nowhere;"},
            r"undefined symbol",
        ),
    ],
)
def test_a_wrong_table_is_refused_with_file_and_field(tmp_path, parts, what):
    extra = ["-Wno-override-init"] if ".cycle = cycle, ." in str(parts) else []
    path = write_c(tmp_path, "bad", small(**parts), *extra)
    with pytest.raises((ModuleLoadError, DeclarationError)) as caught:
        Library([tmp_path]).load("bad")
    text = str(caught.value)
    assert str(path) in text
    assert re.search(what, f"{caught.value.where} {text}", re.DOTALL), text


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (
            lambda data: data[:18] + struct.pack("<H", 243) + data[20:],
            "RISC-V, 64 bits",
        ),
        (lambda data: data[:4] + b"\x01" + data[5:], "32 bits"),
        (lambda _: b"no shared object, but it says pbonet_module", "no shared object"),
        (lambda data: data[:600], "cut short .*at least .*600 bytes"),
        (lambda data: data[: len(data) // 3], "cut short"),
    ],
)
def test_what_is_not_of_this_machine_is_refused(tmp_path, folder, change, what):
    data = change((folder / "pid.so").read_bytes())
    (tmp_path / "pid.so").write_bytes(data)
    with pytest.raises(ModuleLoadError, match=what) as caught:
        Library([tmp_path]).load("pid")
    assert str(tmp_path / "pid.so") in str(caught.value)


@pytest.mark.parametrize(
    ("field", "macro"),
    [
        ("char *y", "PBO_OUT_VAR"),
        ("double *y", "PBO_IN_VAR"),
        ("const double *y", "PBO_OUT_VAR"),
        ("double y", "PBO_OUT_VAR"),
    ],
)
def test_the_compiler_refuses_a_field_of_another_type(tmp_path, field, macro):
    text = small(port=f'{macro}(struct small, y, "Y", "n", "rad", "d")')
    with pytest.raises(AssertionError, match=r"error: .*_Generic"):
        write_c(tmp_path, "bad", text.replace("double *y;", f"{field};"))


def test_a_file_that_is_overwritten_while_it_is_loaded_is_refused(tmp_path):
    path = write_c(tmp_path, "small", small())
    library = Library([tmp_path])
    first = library.load("small")
    other = tmp_path / "new.so"
    compile_c(tmp_path / "small.c", other, "-O0")
    data = path.read_bytes()
    with path.open("r+b") as file:  # the same file, as `cp` writes it
        file.write(data + b"!")
    with pytest.raises(ModuleLoadError, match="overwritten"):
        library.load("small")
    other.rename(path)
    second = library.load("small")
    assert second.info.version != first.info.version
    assert second.cls is not first.cls


CHIMERA = """
#include <pbonet_chimera.h>

typedef struct {
    const float *Q_REF;
    const float *Q_MEZ;
    float *T_REF;
    int *NDOF;
    float gain;
} sampleLocal_t;

static const pbo_port samplePorts[] = {
    PBO_OUT_CONST(sampleLocal_t, NDOF, "NDOF", "1", "none", "degrees of freedom"),
    PBO_IN_VAR(sampleLocal_t, Q_REF, "Q_REF", "NDOF", "rad", "reference"),
    PBO_IN_VAR(sampleLocal_t, Q_MEZ, "Q_MEZ", "NDOF", "rad", "position"),
    PBO_OUT_VAR(sampleLocal_t, T_REF, "T_REF", "NDOF", "N*m", "torque"),
};

SBS_MODULE(sample);

void *sampleInit(cfgInfo_t *cinfo, sampleLocal_t *local, sbsTask_t *stask)
{
    sbsSvar_t *svar = &stask->svar;
    (void)cinfo;
    local->Q_REF = svarTranslateValue(svar->vartable, "Q_REF", float);
    local->Q_MEZ = svarTranslateValue(svar->vartable, "Q_MEZ", float);
    local->T_REF = svarTranslateValue(svar->vartable, "T_REF", float);
    local->NDOF = svarTranslateValue(svar->vartable, "NDOF", int);
    *local->NDOF = 3;
    local->gain = 2.0f;
    return local;
}

int sampleOn(sampleLocal_t *local, sbsTask_t *stask)
{
    (void)stask;
    return local->Q_REF[0] < 0 ? SBS_OFF : I_OK;
}

int sampleCycle(sampleLocal_t *local, sbsTask_t *stask)
{
    for (int i = 0; i < *local->NDOF; i++)
        local->T_REF[i] = local->gain * (local->Q_REF[i] - local->Q_MEZ[i]);
    if (local->T_REF[0] > 50)
        return errInvoke(stask, 3, "too far away");
    return I_OK;
}

int sampleError(sampleLocal_t *local, sbsTask_t *stask, errModule_t *mptr, char *errmsg,
                int errcode)
{
    (void)local, (void)stask, (void)mptr;
    return errcode == 3 && errmsg[0] ? SBS_OFF : SBS_ERROR;
}

int sampleClear(sampleLocal_t *local, sbsTask_t *stask, errModule_t *mptr, char *errmsg,
                int errcode)
{
    (void)local, (void)stask, (void)mptr, (void)errmsg, (void)errcode;
    return SBS_OFF;
}

#define EMPTY(method) \\
    int sample##method(sampleLocal_t *local, sbsTask_t *stask) \\
    { (void)local; (void)stask; return I_OK; }
EMPTY(Off) EMPTY(Kill) EMPTY(Set) EMPTY(Get) EMPTY(Sync) EMPTY(Reinit)
"""


def test_a_module_of_the_thesis_runs_under_its_own_names(tmp_path):
    write_c(tmp_path, "sample", CHIMERA)
    loaded = Library([tmp_path]).load("sample")
    assert loaded.info.ports[0].name == "NDOF"
    bench = Bench(loaded.cls, {"NDOF": 3, "Q_REF": [1, 2, 3], "Q_MEZ": [0, 0, 1]})
    assert bench.outputs.NDOF == 3
    bench.on()
    bench.step()
    assert bench.outputs.T_REF.tolist() == [2.0, 4.0, 4.0]
    bench.inputs.Q_REF = [100, 0, 0]
    assert bench.step() is State.OFF, "sampleError answered SBS_OFF"
    assert "too far away" in bench.task.errmsg
    bench.inputs.Q_REF = [-1, 0, 0]
    assert bench.on() is State.OFF


SAYS = """
#include <pbonet.h>
#include <string.h>
struct says { double *y; int32_t *n; char name[6], law[8]; };
enum { DONE = 3, FULL = 24 };
static const pbo_port ports[] = {
    PBO_OUT_VAR(struct says, y, "Y", "2", "none", "length of the name, 1 if hard",
                PBO_SAFE(7)),
    PBO_OUT_CONST(struct says, n, "N", "1", "none", "a constant", PBO_VALUE(3)),
};
static const pbo_param params[] = {
    PBO_PARAM_TEXT(struct says, name, "a name"),
    PBO_PARAM_TEXT(struct says, law, "how", PBO_TEXT("soft"),
                   PBO_CHOICES("soft", "hard")),
};
static const pbo_user_signal own[] = {
    PBO_USER_SIGNAL(DONE, "DONE", "it is done"),
    PBO_USER_SIGNAL(FULL, "FULL", "it is full"),
};
static int cycle(void *state, pbo_task *task)
{
    struct says *self = state;
    self->y[0] = (double)strlen(self->name);
    self->y[1] = !strcmp(self->law, "hard");
    pbo_signal(task, PBO_USER(DONE));
    return PBO_OK;
}
static int set(void *state, pbo_task *task, int param)
{
    struct says *self = state;
    if (param == 0 && !strcmp(self->name, "no"))
        return pbo_fail(task, 4, "no name");
    return PBO_OK;
}
PBO_MODULE(struct says, "Say.", PBO_PORTS(ports), PBO_PARAMS(params), PBO_SIGNALS(own),
           .cycle = cycle, .set = set);
"""


def test_texts_and_values_of_constants_stand_in_its_struct(tmp_path):
    write_c(tmp_path, "says", SAYS)
    loaded = Library([tmp_path]).load("says")
    name, law = loaded.info.params
    assert (name.type, name.required) == ("str", True)
    assert (law.type, law.default) == ("one of soft, hard", "soft")
    bench = Bench(loaded.cls, params={"name": "joint"})
    assert bench.outputs.n == 3
    assert loaded.info.ports[0].safe == (7.0,), "for both elements"
    bench.on()
    bench.step()
    assert bench.outputs.y.tolist() == [5.0, 0.0]
    bench.set("name", "ä")
    bench.set("law", "hard")
    bench.step()
    assert bench.outputs.y.tolist() == [2.0, 1.0], "UTF-8, and nothing of the old text"
    with pytest.raises(MethodError, match="no name"):
        bench.set("name", "no")
    with pytest.raises(MethodError, match=r"no room for the text .*at most 5 bytes"):
        bench.set("name", "joints")
    bench.step()
    assert bench.outputs.y.tolist() == [2.0, 1.0], "the old text remains"
    with pytest.raises(ParameterError, match=r"none of them 0"):
        Bench(loaded.cls, params={"name": "a\0b"})


def test_its_own_signals_have_names(tmp_path):
    write_c(tmp_path, "says", SAYS)
    loaded = Library([tmp_path]).load("says")
    assert [(one.name, one.number, one.doc) for one in loaded.info.signals] == [
        ("DONE", 3, "it is done"),
        ("FULL", 24, "it is full"),
    ]
    bench = Bench(loaded.cls, params={"name": "a"})
    bench.on()
    bench.step()
    (notice,) = bench.notices()
    assert notice.bits == loaded.cls.DONE == 1 << 10


SCALE = """
#include <pbonet.h>
struct scale { const int32_t *n; const double *x; double *y; double k, cycles; };
static const pbo_port ports[] = {
    PBO_IN_CONST(struct scale, n, "N", "1", "none", "size"),
    PBO_IN_VAR(struct scale, x, "X", "n", "none", "input"),
    PBO_OUT_VAR(struct scale, y, "Y", "n", "none", "output"),
};
static const pbo_param params[] = { PBO_PARAM(struct scale, k, "none", "factor") };
static int cycle(void *state, pbo_task *task)
{
    struct scale *self = state;
    for (int i = 0; i < *self->n; i++)
        self->y[i] = self->k * self->x[i];
    return self->x[0] > 100 ? pbo_fail(task, 3, "too much") : PBO_OK;
}
PBO_MODULE(struct scale, "Scale.", PBO_PORTS(ports), PBO_PARAMS(params),
           .cycle = cycle);
"""
ADDS = """
from typing import Annotated as A
from pbonet import InConst, InVar, OutVar, PortBasedObject, Vector

class Adds(PortBasedObject):
    '''Add one.'''

    n: A[int, InConst("N", "1", "none", "size")]
    x: A[Vector, InVar("X", "n", "none", "input")]
    y: A[Vector, OutVar("Y", "n", "none", "output")]

    def cycle(self, dt: float) -> None:
        self.y[:] = self.x + 1.0
"""
RMOD = (
    "MODULE {}\nDESC a part\n{}INCONST N\nOUTCONST none\nINVAR X\nOUTVAR Y\n"
    "TASKTYPE periodic\nFREQ 100\n{}EOF\n"
)


def test_a_combination_of_two_in_c_and_one_in_python(tmp_path):
    write_c(tmp_path, "scale", SCALE)
    (tmp_path / "adds.py").write_text(ADDS)
    files = {
        "first": ("scale", "SVARALIAS Y=A\n", "LOCAL\nK 2\n"),
        "second": ("adds", "SVARALIAS X=A\nSVARALIAS Y=B\n", ""),
        "third": ("scale", "SVARALIAS X=B\n", "LOCAL\nK 10\n"),
    }
    for name, (module, aliases, local) in files.items():
        (tmp_path / f"{name}.rmod").write_text(RMOD.format(module, aliases, local))
    whole = "COMBINE first second third\nDESC all\nINCONST N\nOUTCONST none\nINVAR X\n"
    (tmp_path / "all.rmod").write_text(
        f"{whole}OUTVAR Y\nTASKTYPE periodic\nFREQ 100\nEOF\n"
    )
    bench = Bench.of(tmp_path / "all.rmod", {"n": 2, "x": [1, 2]}, library=[tmp_path])
    bench.on()
    bench.step()
    assert bench.outputs.y.tolist() == [30.0, 50.0]
    bench.set("third.k", 100.0)
    bench.step()
    assert bench.outputs.y.tolist() == [300.0, 500.0]
    bench.inputs.x = [200, 0]
    with pytest.raises(MethodError, match=r"first.*too much"):
        bench.step()
