"""Cycles of a module in C: `Slot.run` does them alone, without the interpreter.

Task and dispatcher share this test's process, under ``park``, so no level is touched.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from contextlib import contextmanager

import pytest
from c_modules import write_c

from pbonet.cmodule import NativeMethod, NativeState, SharedObject
from pbonet.config.model import Variable
from pbonet.node.rt import _rt
from pbonet.pbo import TaskContext, TaskFailure
from pbonet.svar import Action, Table

MS = 1_000_000
DOUBLES = """
#include <pbonet.h>

struct doubles { const double *x; double *y; double pad; };
static const pbo_port ports[] = {
    PBO_IN_VAR(struct doubles, x, "IN", "2", "none", "numbers"),
    PBO_OUT_VAR(struct doubles, y, "OUT", "2", "none", "twice as much, and cycles"),
};
static const pbo_param params[] = {
    PBO_PARAM(struct doubles, pad, "none", "nothing", PBO_DEFAULT(0)),
};

static int cycle(void *state, pbo_task *task)
{
    struct doubles *self = state;
    self->y[0] = 2 * self->x[0];
    self->y[1] += 1;
    return self->x[1] ? pbo_fail(task, 7, "x is %g", self->x[1]) : PBO_OK;
}

static int stable(void *state, pbo_task *task)
{
    struct doubles *self = state;
    (void)task;
    self->y[0] = -1;
    return PBO_OK;
}

PBO_MODULE(struct doubles, "Doubles.", PBO_PORTS(ports), PBO_PARAMS(params),
           .cycle = cycle, .stable = stable);
"""


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("library")
    return SharedObject(str(write_c(folder, "doubles", DOUBLES)))


@pytest.fixture
def svar(core):  # noqa: ARG001 - it sets the folder
    variables = [Variable(name=name, type="double", nelem=2) for name in ("IN", "OUT")]
    table = Table.create("rtcycles", variables)
    yield table
    table.destroy()


@pytest.fixture
def local(svar):
    local = svar.local("t", os.getpid(), invar=["IN"], outvar=["OUT"])
    local.claim()
    yield local
    local.close()


@pytest.fixture
def state(shared, local):
    """The state of the module, over the memory of the local table."""
    arrays = {"x": local.array("IN"), "y": local.array("OUT")}
    return NativeState(shared, TaskContext(), arrays, {"pad": 0.0})


@pytest.fixture
def ring(core):  # noqa: ARG001 - as above
    ring = _rt.Ring.create("t")
    yield ring
    ring.destroy()


@contextmanager
def meanwhile(act):
    """Call a function in a thread while the block runs."""
    thread = threading.Thread(target=act)
    thread.start()
    yield
    thread.join()


def test_cycles_go_on_while_another_thread_keeps_the_interpreter(
    core, slot, svar, local, state, *, ring
) -> None:
    svar.write("IN", [4.0, 0.0])
    went = []

    def act():
        while core.snapshot(slot.index).cycles < 2:
            time.sleep(0.001)
        before = sys.getswitchinterval()
        sys.setswitchinterval(3600.0)  # nobody else gets it from here on
        first, ends = slot.cycles, time.monotonic() + 60.0
        while slot.cycles < first + 5 and time.monotonic() < ends:
            pass
        went.append(slot.cycles - first)
        core.request(slot.index)
        sys.setswitchinterval(before)

    with meanwhile(act):
        assert slot.run(NativeMethod(state, "cycle"), local, ring=ring) == _rt.COMMAND
    assert went[0] >= 5
    records = ring.drain()
    count = core.snapshot(slot.index).cycles
    assert [r.cycle for r in records] == list(range(1, count + 1))
    assert svar.read("OUT").tolist() == [8.0, count]
    assert (svar.info("OUT").owner, svar.info("OUT").cycle) == ("t", count)
    assert not any(r.flags or r.stable for r in records)


def test_an_error_comes_through_and_nothing_is_committed(
    core, slot, svar, local, state, *, ring
) -> None:
    svar.write("IN", [4.0, 0.0])

    def act():
        while core.snapshot(slot.index).cycles < 3:
            time.sleep(0.001)
        svar.write("IN", [5.0, 3.0])

    with meanwhile(act), pytest.raises(TaskFailure, match="x is 3"):
        slot.run(NativeMethod(state, "cycle"), local, ring=ring)
    status = core.snapshot(slot.index)
    assert status.failed == 1
    assert svar.read("OUT").tolist() == [8.0, status.cycles]
    assert len(ring.drain()) == status.cycles, "as of any cycle that failed, none"


def test_what_is_not_finite_is_refused(core, slot, svar, local, state) -> None:
    svar.write("IN", [1e308, 0.0])
    assert slot.run(NativeMethod(state, "cycle"), local) == _rt.FLAGS
    assert slot.flags == 16
    assert svar.read("OUT").tolist() == [0.0, 0.0]
    assert core.snapshot(slot.index).failed == 1


def test_stable_runs_in_its_place_while_the_flag_is_up(
    core, slot, svar, local, state, *, ring
) -> None:
    def act():
        while core.snapshot(slot.index).cycles < 2:
            time.sleep(0.001)
        svar.raise_illegal("a task died", "test")
        while svar.read("OUT")[0] != -1.0:
            time.sleep(0.001)
        svar.clear_illegal("test")
        while svar.read("OUT")[0] == -1.0:
            time.sleep(0.001)
        core.request(slot.index)

    methods = [NativeMethod(state, name) for name in ("cycle", "stable")]
    with meanwhile(act):
        ended = slot.run(
            methods[0], local, stable=methods[1], critical=Action.STABLE, ring=ring
        )
    assert ended == _rt.COMMAND
    ran = "".join("s" if r.stable else "c" for r in ring.drain())
    assert ran.strip("c").strip("s") == "", ran
    assert core.snapshot(slot.index).stable_cycles == ran.count("s") > 0
