"""A death is known at once: the kernel tells, and nobody has to look."""

from __future__ import annotations

import os
import signal
import threading

import pytest
from long_limits import LIMIT
from watching import wait_for

from pbonet.analysis.schedule.records import Mode
from pbonet.config.model import Variable
from pbonet.node.rt import _rt
from pbonet.svar import Table

CORE = max(os.sched_getaffinity(0))
VARIABLES = [Variable(name="V", type="double", nelem=1)]


@pytest.fixture
def core():
    table = _rt.CoreTable(CORE)
    yield table
    table.close()


@pytest.fixture
def vigil(core):
    dispatcher = _rt.Dispatcher(core, "park")
    dispatcher.start()
    watching = _rt.Vigil(dispatcher)
    yield watching
    watching.stop()
    dispatcher.stop()


@pytest.fixture
def table():
    with Table.create("vigil", VARIABLES) as made:
        yield made
        made.destroy()


def child(slot, *, arm, vow=True, stands=False):
    """Fork a process that holds a slot, and sleeps or stands by; return its number."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            mine = _rt.Slot(_rt.CoreTable(CORE, member=False), slot)
            if vow:
                mine.vow()
            if arm:
                mine.arm()
            os.write(write, b"!")
            if stands:
                mine.stand_by()
            while True:
                signal.pause()
        finally:
            os._exit(1)
    os.read(read, 1)
    os.close(read)
    os.close(write)
    return pid


def watch(vigil, slot, table):
    words = b"r/t", b"t has died", b"t is in ERROR"
    vigil.watch(slot, table.arena, *words)


def causes(table):
    return [(cause.cause, cause.raiser) for cause in table.illegal]


def test_a_death_raises_the_flag_and_tells_the_dispatcher(core, vigil, table):
    slot = core.alloc("r", "t")
    pid = child(slot, arm=True)
    watch(vigil, slot, table)
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: core.snapshot(slot).dead, "the news of the death")
    assert causes(table) == [("t has died", "r/t")]
    assert vigil.counts == (1, 0)
    os.waitpid(pid, 0)
    assert table.clear_illegal("r/t") == 1  # it was this process that raised it
    core.free(slot)


def test_the_end_of_a_task_that_is_off_raises_nothing(core, vigil, table):
    slot = core.alloc("r", "t")
    pid = child(slot, arm=False)
    watch(vigil, slot, table)
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: core.snapshot(slot).dead, "the news of the death")
    assert causes(table) == []
    os.waitpid(pid, 0)
    core.free(slot)


def test_a_task_in_error_raises_the_flag(core, vigil, table):
    slot = core.alloc("r", "t")
    mine = _rt.Slot(core, slot)
    mine.vow()
    mine.arm()
    watch(vigil, slot, table)
    mine.fall()
    wait_for(lambda: causes(table), "the flag")
    assert causes(table) == [("t is in ERROR", "r/t")]
    assert core.snapshot(slot).mode is Mode.OFF
    table.clear_illegal("r/t")
    core.free(slot)


def test_many_deaths_at_once_and_slots_used_again(core, vigil, table):
    for _ in range(3):
        slots = [core.alloc("r", f"t{k}") for k in range(20)]
        pids = [child(slot, arm=True) for slot in slots]
        for slot in slots:
            watch(vigil, slot, table)
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        for slot, pid in zip(slots, pids, strict=True):
            wait_for(lambda slot=slot: core.snapshot(slot).dead, f"the death of {slot}")
            os.waitpid(pid, 0)
            vigil.forget(slot)
            core.free(slot)
    assert vigil.counts[0] == 60


def test_who_frees_the_slot_of_a_task_that_was_armed_says_that_it_died(core, vigil):
    first, second = core.alloc("r", "t"), core.alloc("r", "u")
    pid = child(first, arm=True, vow=False)
    heir = _rt.Slot(core, second)
    core.follow(second, [first])
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    core.died(first)
    core.free(first)
    assert heir.stand_by() == _rt.ENGAGED
    assert vigil.counts == (0, 0)
    heir.disarm()
    core.free(second)


def test_a_task_that_died_before_the_dispatcher_saw_it_on(core):
    """The dispatcher stood still from before its arming until its slot was free."""
    first, second = core.alloc("r", "t"), core.alloc("r", "u")
    core.follow(second, [first])
    pid = child(first, arm=True)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    core.died(first)
    core.free(first)
    heir = _rt.Slot(core, second)
    dispatcher = _rt.Dispatcher(core, "park")
    dispatcher.start()
    end = threading.Timer(LIMIT, core.request, [second])
    end.start()
    try:
        wait_for(lambda: core.trace(0)[2], "its first turn")
        assert heir.stand_by() == _rt.ENGAGED
        heir.disarm()
    finally:
        end.cancel()
        dispatcher.stop()
    core.free(second)


def test_a_command_ends_standing_by(core, vigil):
    slot = core.alloc("r", "t")
    heir = _rt.Slot(core, slot)
    core.follow(slot, [slot])
    core.request(slot)
    assert heir.stand_by() == _rt.COMMAND
    assert core.snapshot(slot).mode is Mode.OFF
    assert vigil.counts == (0, 0)
    core.free(slot)


@pytest.mark.parametrize(
    "fallen", [True, False], ids=["fallback in on", "fallback that nobody needs"]
)
def test_the_end_of_who_comes_on_raises_the_flag(core, vigil, table, fallen):
    """It stands by for another task, and is killed before it is ON."""
    old, new = core.alloc("r", "old"), core.alloc("r", "t")
    core.follow(new, [old])
    first = _rt.Slot(core, old)
    first.arm()
    pid = child(new, arm=False, stands=True)
    wait_for(lambda: core.snapshot(new).mode is Mode.STANDS, "standing by")
    watch(vigil, new, table)
    if fallen:
        first.fall()
        wait_for(lambda: core.snapshot(new).comes, "that it is engaged")
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: core.snapshot(new).dead, "the news of the death")
    assert core.snapshot(new).comes is fallen
    assert causes(table) == [("t has died", "r/t")] * fallen
    assert vigil.counts[0] == fallen
    os.waitpid(pid, 0)
    first.disarm()
    core.free(new)
    core.free(old)


@pytest.mark.parametrize("calls", [0, 1, 2])
def test_the_end_of_a_successor_that_was_called_raises_the_flag(
    core, vigil, table, calls
):
    """It waits for two tasks; one that has called it has ended."""
    slot = core.alloc("r", "t")
    life = core.expect(slot, ticket=7, callers=2)
    pid = child(slot, arm=False, stands=True)
    wait_for(lambda: core.snapshot(slot).mode is Mode.STANDS, "standing by")
    watch(vigil, slot, table)
    for caller in range(calls):
        assert core.call(slot, life, 7, caller)
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: core.snapshot(slot).dead, "the news of the death")
    assert core.snapshot(slot).comes is core.snapshot(slot).called is bool(calls)
    assert causes(table) == [("t has died", "r/t")] * bool(calls)
    assert vigil.counts[0] == bool(calls)
    assert not core.call(slot, life, 7, 1), "nobody hears that"
    os.waitpid(pid, 0)
    core.follow(slot, [])
    assert not core.snapshot(slot).called
    core.free(slot)
