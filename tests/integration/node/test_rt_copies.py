"""What `Slot.run` does around a cycle: copies, flags, exceptions, records.

Task and dispatcher share this test's process, under ``park``, so no level is touched.
"""

from __future__ import annotations

import itertools
import math
import os
import signal
import time

import numpy as np
import pytest

from pbonet.analysis.schedule.records import Kind, Mode
from pbonet.config.model import Limit, Variable
from pbonet.errors import NodeError
from pbonet.log import Step
from pbonet.node.rt import _rt
from pbonet.outside import Outside, Player, Tape, using
from pbonet.pbo import CycleAborted
from pbonet.svar import Table

MS = 1_000_000


@pytest.fixture
def svar(core):  # noqa: ARG001 - it sets the folder
    table = Table.create(
        "rtcopies",
        [
            Variable(name="IN", type="double", nelem=3, init=(1.0, 2.0, 3.0)),
            Variable(name="OUT", type="double", nelem=3),
            Variable(
                name="TIGHT", type="double", nelem=1, min=(-1.0,), max=(1.0,),
                limit=Limit.ERROR,
            ),
        ],
    )  # fmt: skip
    yield table
    table.destroy()


@pytest.fixture
def local(svar):
    local = svar.local("t", os.getpid(), invar=["IN"], outvar=["OUT", "TIGHT"])
    local.claim()
    yield local
    local.close()


def ending(core, slot, count, body=lambda _dt: None):
    """Return a cycle that asks for a command in its `count`-th run."""
    left = iter(range(count - 1, -1, -1))

    def cycle(dt):
        body(dt)
        if next(left) == 0:
            core.request(slot.index)

    return cycle


def test_inputs_come_in_and_outputs_go_out(core, slot, svar, local) -> None:
    inputs, outputs, ring = local.array("IN"), local.array("OUT"), _rt.Ring.create("t")
    svar.write("IN", [4.0, 5.0, 6.0])

    def body(_dt):
        outputs[:] = 2 * inputs

    assert slot.run(ending(core, slot, 3, body), local, ring=ring) == _rt.COMMAND
    assert svar.read("OUT").tolist() == [8.0, 10.0, 12.0]
    info = svar.info("OUT")
    assert (info.owner, info.cycle) == ("t", 3)
    records = ring.drain()
    assert [r.cycle for r in records] == [1, 2, 3]
    assert records[-1].consumed == tuple(local.consumed)
    assert records[-1].data.startswith(outputs.tobytes())
    assert records[-1].flags == 0
    assert not records[-1].stable
    status = core.snapshot(slot.index)
    assert status.copy_in_ns > 0
    assert status.copy_out_ns > 0
    assert status.mode is Mode.COMMAND
    ring.destroy()


def test_inputs_are_stored_when_they_do_not_follow_from_commits(
    core, slot, svar, local
) -> None:
    ring = _rt.Ring.create("t", about=b"whose")
    reader = _rt.Ring.attach("t")
    assert reader.about == b"whose"
    svar.write("IN", [4.0, 5.0, 6.0])
    cycles = itertools.count(1)

    def body(_dt):
        now = next(cycles)
        if now == 3:
            svar.write("IN", [7.0, 8.0, 9.0])
        if now == 5:
            reader.want()
        if now == 7:
            reader.want(always=True)

    assert slot.run(ending(core, slot, 10, body), local, ring=ring) == _rt.COMMAND
    text = reader.take()
    records = _rt.parse(text)
    assert reader.take() == b""
    stored = [list(np.frombuffer(r.inputs)) for r in records]
    first, second = [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]
    assert stored == [first, [], [], second, [], second, [], second, second, second]
    assert {r.uid for r in records} == {local.out_uid}
    numbers = [r.number for r in records]
    assert numbers == list(range(numbers[0], numbers[0] + 10))
    assert numbers[-1] == local.out_number
    releases = [r.release_ns for r in records]
    assert [r.dt_ns for r in records[1:]] == np.diff(releases).tolist()
    reader.close()
    ring.destroy()


@pytest.mark.parametrize(
    ("name", "value", "flag"), [("OUT", math.nan, 16), ("TIGHT", 7.0, 32)]
)
def test_refused_outputs_end_the_run_and_stay_unwritten(
    core, slot, svar, local, *, name, value, flag
) -> None:
    out = local.array(name)
    before = svar.read(name).tolist()

    def cycle(_dt):
        out[0] = value

    assert slot.run(cycle, local) == _rt.FLAGS
    assert slot.flags == flag
    assert svar.read(name).tolist() == before
    status = core.snapshot(slot.index)
    assert (status.cycles, status.failed) == (0, 1)
    assert status.missed >= 1


def test_an_exception_comes_through_and_nothing_is_committed(
    core, slot, svar, local
) -> None:
    out = local.array("OUT")

    def cycle(_dt):
        out[0] = 5.0
        msg = "no"
        raise KeyError(msg)

    with pytest.raises(KeyError, match="no"):
        slot.run(cycle, local)
    assert svar.read("OUT").tolist() == [0.0, 0.0, 0.0]
    assert slot.armed
    assert core.snapshot(slot.index).failed == 1
    assert slot.run(ending(core, slot, 2), local) == _rt.COMMAND
    assert core.snapshot(slot.index).cycles == 2


def test_dt_spans_a_cycle_that_failed(core, slot) -> None:
    steps = []

    def body(dt):
        steps.append(dt)
        if len(steps) == 2:
            msg = "bad"
            raise ValueError(msg)

    with pytest.raises(ValueError, match="bad"):
        slot.run(body, None)
    slot.run(ending(core, slot, 1, body), None)
    assert steps[2] >= 2 * steps[0] - 1e-9


def test_stable_runs_while_the_flag_is_up(core, slot, svar, local) -> None:
    seen = []
    ring = _rt.Ring.create("t")

    def cycle(_dt):
        seen.append("cycle")
        if len(seen) == 2:
            svar.raise_illegal("a task died", "test")

    def stable(_dt):
        seen.append("stable")
        if len(seen) == 4:
            svar.clear_illegal("test")
        if len(seen) == 4:
            core.request(slot.index)

    assert slot.run(cycle, local, stable=stable, critical=2, ring=ring) == _rt.COMMAND
    assert seen == ["cycle", "cycle", "stable", "stable"]
    assert [r.stable for r in ring.drain()] == [False, False, True, True]
    assert core.snapshot(slot.index).stable_cycles == 2
    ring.destroy()


def test_without_stable_the_cycle_runs_on(core, slot, svar, local) -> None:
    svar.raise_illegal("a task died", "test")
    assert slot.run(ending(core, slot, 2), local) == _rt.COMMAND
    svar.clear_illegal("test")


def test_a_lost_claim_is_told(slot, local) -> None:
    local.release()
    assert slot.run(lambda _dt: None, local) == _rt.FLAGS
    assert slot.flags == 64


def test_what_to_leave_on_can_be_chosen(core, slot, local) -> None:
    out = local.array("OUT")
    out[0] = math.inf
    assert slot.run(ending(core, slot, 2), local, leave=0) == _rt.COMMAND
    assert core.snapshot(slot.index).failed == 2


def test_a_full_ring_delays_nobody_and_is_counted(core, slot) -> None:
    ring = _rt.Ring.create("t", 1)
    while ring.put(b""):
        pass
    assert slot.run(ending(core, slot, 3), None, ring=ring) == _rt.COMMAND
    assert core.snapshot(slot.index).ring_lost == 3
    ring.destroy()


def test_python_signals_are_handled_while_waiting(core, slot) -> None:
    class Stop(Exception):  # noqa: N818 - not an error
        pass

    def handler(_signal, _frame):
        raise Stop

    core.configure(slot.index, period_ns=3600 * 1000 * MS)
    old = signal.signal(signal.SIGALRM, handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
        with pytest.raises(Stop):
            slot.run(lambda _dt: None, None)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)
    assert core.snapshot(slot.index).cycles == 0


def test_a_command_that_waits_already_is_served_at_once(core, slot) -> None:
    core.configure(slot.index, period_ns=3600 * 1000 * MS)
    core.request(slot.index)
    assert slot.pending
    assert slot.run(lambda _dt: None, None) == _rt.COMMAND
    assert not slot.pending
    assert slot.cycles == 0


def test_context_is_to_be_had_inside_the_cycle(core, slot) -> None:
    seen = []

    def body(_dt):
        seen.append((slot.cycles, slot.release_ns, slot.period_ns, slot.missed))

    slot.run(ending(core, slot, 3, body), None)
    assert [s[0] for s in seen] == [0, 1, 2]
    assert all(s[1] % (2 * MS) == 0 for s in seen)
    assert all(s[2] == 2 * MS for s in seen)


def test_a_synchronous_task_is_timed_by_its_own_events(core) -> None:
    i = core.alloc("r", "sync")
    core.configure(i, kind=Kind.SYNCHRONOUS, crit=5)
    slot = _rt.Slot(core, i)
    steps, events = [], iter([0.01, 0.02, 0.01])

    def sync():
        time.sleep(next(events))

    def body(dt):
        steps.append(dt)

    assert slot.run(ending(core, slot, 3, body), None, sync=sync) == _rt.COMMAND
    assert steps[0] >= 0.01
    assert steps[1] >= 0.02
    assert core.snapshot(i).cycles == 3
    assert core.snapshot(i).missed == 0
    slot.disarm()
    with pytest.raises(ValueError, match="required for tasks that are not periodic"):
        slot.run(lambda _dt: None, None)


@pytest.fixture
def tape(slot):
    slot.tape = Tape()
    with using(slot.tape):
        yield slot.tape


@pytest.mark.usefixtures("tape")
def test_each_wait_is_recorded_whatever_was_heard(core, slot) -> None:
    core.configure(slot.index, kind=Kind.SYNCHRONOUS)
    ring, outside, waits = _rt.Ring.create("t"), Outside("it"), iter(range(4))
    slot.tape.take()

    def abort():
        raise CycleAborted

    def sync():
        n = next(waits)
        outside.ask(abort if n == 2 else lambda: b"x" * (n == 1), default=b"")

    assert slot.run(ending(core, slot, 3), None, sync=sync, ring=ring) == _rt.COMMAND
    assert [(r.kind, len(r.data) > 0) for r in ring.drain()] == [
        *((Step.SYNC, False), (Step.CYCLE, False)),
        *((Step.SYNC, True), (Step.CYCLE, False)),
        (Step.SYNC, True),  # aborted
        *((Step.SYNC, False), (Step.CYCLE, False)),
    ]
    ring.destroy()


@pytest.mark.usefixtures("tape")
def test_a_cycle_that_heard_more_than_the_ring_holds_stays_on_record(
    core, slot, local
) -> None:
    ring, outside, out = _rt.Ring.create("t", 1), Outside("it"), local.array("OUT")
    sizes = iter([8, 1 << 14, 8])

    def body(_dt):
        out[0] += len(outside.ask(bytes, next(sizes)))

    assert slot.run(ending(core, slot, 3, body), local, ring=ring) == _rt.COMMAND
    records = ring.drain()
    assert [np.frombuffer(r.data)[0] for r in records] == [8.0, 16392.0, 16400.0]
    assert [Player().feed(r.heard) for r in records] == [False, True, False]
    assert core.snapshot(slot.index).ring_lost == 0
    ring.destroy()


def test_inputs_that_found_no_room_are_stored_by_the_next_cycle(
    core, slot, svar, local
) -> None:
    ring = _rt.Ring.create("t", 1)
    while ring.put(b"\xff" * 64):
        pass
    svar.write("IN", [4.0, 5.0, 6.0])
    emptied = []

    def body(_dt):
        if not emptied:
            emptied.extend(ring.drain())

    assert slot.run(ending(core, slot, 3, body), local, ring=ring) == _rt.COMMAND
    stored = [list(np.frombuffer(r.inputs)) for r in ring.drain()]
    assert stored == [[], [4.0, 5.0, 6.0], []]
    ring.destroy()


@pytest.mark.usefixtures("core")
def test_a_closed_table_is_no_crash() -> None:
    table = _rt.CoreTable(1)
    i = table.alloc("r", "x")
    slot = _rt.Slot(table, i)
    table.free(i)
    table.close()
    for use in (
        lambda: slot.cycles,
        lambda: slot.armed,
        slot.disarm,
        lambda: slot.run(lambda _dt: None, None),
    ):
        with pytest.raises(NodeError, match="the core table is closed"):
            use()
