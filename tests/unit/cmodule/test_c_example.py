"""The example in C: in virtual time, swapped with its twin, run again from a log."""

import shutil
import subprocess
import sys
import sysconfig

import numpy as np
import pytest
from c_modules import EXAMPLE, write_c
from virtual_job import VirtualJob

from benchmarks import cmodules
from pbonet.config import Library
from pbonet.master.tools.scaffold_c import MAKEFILE
from pbonet.node.ring._ring import Ring
from pbonet.testing import Bench, verify

LAW = """
def law(const double[::1] q, double[::1] tau, double k):
    cdef int i
    for i in range(q.shape[0]):
        tau[i] = -k * q[i]
"""
SPRING = """
from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector

from ._law import law


class Spring(PortBasedObject):
    q: A[Vector, InVar("Q", "3", "rad", "position")]
    tau: A[Vector, OutVar("T", "3", "N*m", "torque")]

    def cycle(self, dt: float) -> None:
        law(self.q, self.tau, 2.0)
"""
TELLS = """
#include <pbonet.h>
struct tells { double *y; };
static const pbo_port ports[] = {
    PBO_OUT_VAR(struct tells, y, "Y", "4", "none", "what the task says"),
};
static int cycle(void *state, pbo_task *task)
{
    struct tells *self = state;
    self->y[0] = task->dt;
    self->y[1] = (double)task->now_ns;
    self->y[2] = (double)task->cyclecount;
    self->y[3] = task->period;
    return task->cyclecount == 150 ? pbo_fail(task, 3, "at %d", 150) : PBO_OK;
}
static int error(void *state, pbo_task *task)
{
    (void)state;
    return task->errnum == 3 ? PBO_CONTINUE : PBO_ERROR;
}
PBO_MODULE(struct tells, "Tell.", PBO_PORTS(ports), .cycle = cycle, .error = error);
"""
FILES = {
    "t.job": "JOB t\nDESC t\nSBS t.sbs\nTASK tells arm0\nEOF\n",
    "t.sbs": "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nEOF\n",
    "t.svar": "NAME Y\nTYPE double\nDESC told\nUNITS none\nNELEM 4\nEOF\n",
    "tells.rmod": "MODULE tells\nDESC tells\nINCONST none\nOUTCONST none\nINVAR none\n"
    "OUTVAR Y\nTASKTYPE periodic\nFREQ 100\nEOF\n",
}


@pytest.fixture
def example(tmp_path):
    """A copy of the example, built by its own Makefile."""
    folder = tmp_path / "c_pid"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("*.so"))
    make = ["make", "--silent", "-C", folder, f"PYTHON={sys.executable}"]
    subprocess.run(make, check=True)
    return folder


def test_it_is_built_by_the_makefile_that_new_modules_get():
    assert (EXAMPLE / "Makefile").read_text() == MAKEFILE


def test_200_swaps_with_its_twin_lose_no_cycle(example):
    with_twin = VirtualJob(example / "c_pid.job")
    try:
        with_twin.start()
        with_twin.spawn("joint_pid")
        for old, new in (("pid", "joint_pid"), ("joint_pid", "pid")) * 100:
            with_twin.wait(0.01)
            with_twin.swap(old, new)
        with_twin.wait(0.01)
        with_twin.stop()
        recording = with_twin.recording
    finally:
        with_twin.close()
    parts = [recording.arrays(name) for name in ("pid", "joint_pid")]
    assert all(len(part["release_ns"]) > 300 for part in parts)
    releases = np.concatenate([part["release_ns"] for part in parts])
    order = np.argsort(releases)
    assert set(np.diff(releases[order])) == {2_000_000}, "one cycle at each release"
    torque = np.concatenate([part["T_REF"] for part in parts])[order]
    assert np.abs(np.diff(torque, axis=0)).max() < 0.5, "and no torque jumps"


def test_the_benchmark_tells_the_machine_s_losses_from_those_of_a_swap():
    """A release without a cycle is excused by a C loop that was late meanwhile."""
    ms, period = 1_000_000, cmodules.PERIOD
    times = [0, 1, 2, 4, 5, 7, 8, 10, 11]  # 3, 6 and 9 have no cycle
    whose = [0, 0, 0, 1, 1, 1, 1, 0, 0]
    releases = [(one * period, who) for one, who in zip(times, whose, strict=True)]
    on_time = cmodules.judged(releases, [])
    assert on_time == (12, (2, 0), (1, 0), 0), "two at swaps, one elsewhere"
    due = 3 * period - ms  # as the machine stood still at the first swap
    late = [(due, due + period), (6 * period - ms, 6 * period - ms + ms // 4)]
    assert cmodules.judged(releases, late) == (12, (1, 1), (1, 0), 0)
    twice = sorted([*releases, (4 * period, 0)])
    assert cmodules.judged(twice, []) == (13, (1, 0), (2, 0), 0), "nothing is made good"


def test_the_benchmark_counts_cycles_whose_records_a_ring_had_no_room_for():
    ring = Ring.create("full", 4096)
    try:
        ring.put(bytes(48), cycle=1)
        with cmodules.Drained(["full"]) as drained:
            for number in range(2, 500):
                ring.put(bytes(48), cycle=number)
        assert drained.dropped > 0
        assert len(drained.releases) + drained.dropped == 499
    finally:
        ring.destroy()


def logged(call, job, runs):
    """Run a job in virtual time; return its log."""
    status, _, said = call("run", job, "--sim", "--seconds", 2, "--runs", runs)
    assert status == 0, said
    (folder,) = runs.iterdir()
    return folder


def test_what_one_twin_wrote_the_other_writes_again_to_the_bit(example, tmp_path, call):
    in_c = logged(call, example / "c_pid.job", tmp_path / "in_c")
    text = (example / "c_pid.job").read_text()
    (example / "python.job").write_text(text.replace("TASK  pid ", "TASK  joint_pid "))
    in_python = logged(call, example / "python.job", tmp_path / "in_python")
    twins = tmp_path / "twins"
    twins.mkdir()
    shutil.copy(example / "pid.so", twins / "joint_pid.so")
    (twins / "pid.py").write_text(
        "from pbonet.modules.controllers.joint_pid import JointPID\n\n\n"
        "class Pid(JointPID):\n    pass\n"
    )
    for log, task in ((in_c, "pid"), (in_python, "joint_pid")):
        assert call("replay", log, task, "--verify")[0] == 0
        command = ("replay", log, task, "--verify", "--library", twins)
        status, told, said = call(*command)
        assert status == 0, told + said
        assert "1000 cycles identical" in told
    assert Library([twins]).load("joint_pid").path.suffix == ".so"


@pytest.mark.parametrize("ki", [0.0, 2.0])
def test_both_twins_go_the_same_way_to_a_reference_far_away(example, ki):
    """Through an aborted cycle, a swap away and back, and a robot moved by hand."""
    gains = {"kp": 3.0, "limit": 20.0, "ki": ki, "kd": 0.3, "speed": 0.7}
    classes = (Library([example]).load("pid").cls, Library().load("joint_pid").cls)
    twins = [Bench(one, params=gains, ndof=3, freq=500) for one in classes]
    rng = np.random.default_rng(1)
    told = []

    def run(cycles):
        for _ in range(cycles):
            q_ref, q, qd = rng.normal(size=(3, 3))
            for one in twins:
                one.inputs.q_ref, one.inputs.q, one.inputs.qd = q_ref, q, qd
                one.step()
            told.append([one.outputs.tau.copy() for one in twins])

    for handover in (False, True, False, True, True):
        for one in twins:
            one.on(handover=handover)
        run(20)
        for one in twins:
            one.executor.abort()
        run(20)
        for one in twins:
            one.off(handover=True)
    told = np.array(told)
    assert len(np.unique(told)) > 300, "most are no limit"
    assert told[:, 0].tobytes() == told[:, 1].tobytes()


def test_a_log_knows_the_version_of_a_module_in_c(example, tmp_path, call):
    log = logged(call, example / "c_pid.job", tmp_path / "in_c")
    source = example / "pid.c"
    source.write_text(source.read_text().replace("->ki * error", "->ki * 2 * error"))
    subprocess.run(
        ["make", "--silent", "-C", example, f"PYTHON={sys.executable}"], check=True
    )
    status, told, said = call("replay", log, "pid", "--verify")
    assert status == 1, told + said
    assert "pid.so" in told + said


@pytest.fixture
def tells(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    write_c(tmp_path, "tells", TELLS)
    return tmp_path / "t.job"


def test_the_native_loop_tells_the_same_as_a_call_from_python(tells):
    job = VirtualJob(tells)
    try:
        recording = job.run(2.0)
    finally:
        job.close()
    cycles = recording.arrays("tells")
    told = cycles["Y"]
    assert len(told) == 200, "an error that `error` corrects costs no cycle"
    assert told[:, 0].tolist() == [0.01] * 200
    assert told[:, 1].tolist() == cycles["release_ns"].tolist()
    assert told[:, 2].tolist() == list(range(200))
    assert told[:, 3].tolist() == [0.01] * 200


def test_a_replay_tells_a_module_the_same(tells, tmp_path, call):
    log = logged(call, tells, tmp_path / "runs")
    (verdict,) = verify(log)
    assert verdict.good, str(verdict)
    assert verdict.cycles == 200


def test_a_law_in_cython_stands_beside_a_module_in_python(tmp_path):
    (tmp_path / "_law.pyx").write_text(LAW)
    (tmp_path / "spring.py").write_text(SPRING)
    cython = [sys.executable, "-m", "cython", "-3", tmp_path / "_law.pyx"]
    subprocess.run(cython, check=True)
    include = sysconfig.get_paths()["include"]
    target = tmp_path / f"_law{sysconfig.get_config_var('EXT_SUFFIX')}"
    cc = ["cc", "-O0", "-shared", "-fPIC", f"-I{include}", tmp_path / "_law.c"]
    subprocess.run([*cc, "-o", target], check=True)
    library = Library([tmp_path])
    assert {path.stem for path in tmp_path.glob("*.so")} & set(
        library.modules()
    ) == set()
    bench = Bench(library.load("spring").cls, {"q": [1.0, 2.0, 3.0]})
    bench.on()
    bench.step()
    assert bench.outputs.tau.tolist() == [-2.0, -4.0, -6.0]


@pytest.mark.parametrize(
    "ports",
    [
        [
            "--inconst",
            "NDOF:1:none:int",
            "--in",
            "Q:ndof:rad:float",
            "--out",
            "F:1:none:bool",
        ],
        [
            "--outconst",
            "NDOF:1:none:int64",
            "--out",
            "Q:ndof,3:rad",
            "--timing-failure",
        ],
        [],
    ],
)
def test_a_new_module_is_built_and_passes_its_test(tmp_path, call, ports):
    status, told, said = call(
        "new", "module", "spring", "--c", *ports, "--folder", tmp_path
    )
    assert status == 0, said
    assert "spring.c" in told
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "warning" not in done.stderr
    status, _, said = call("new", "module", "damper", "--c", "--folder", tmp_path)
    assert status == 0, said + "the same Makefile stays"


@pytest.mark.parametrize(
    ("port", "what"),
    [
        ("X:n:rad", "the size n of port X is no constant"),
        ("X:1:none:struct[8]", "port X is a structure"),
        ("REGISTER:1:none", "would be a keyword of C"),
    ],
)
def test_a_new_module_in_c_has_ports_that_c_can_have(tmp_path, call, port, what):
    status, _, said = call(
        "new", "module", "spring", "--c", "--in", port, "--folder", tmp_path
    )
    assert status == 1
    assert what in said
    assert list(tmp_path.glob("spring*")) == []
