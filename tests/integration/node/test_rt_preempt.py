"""A more urgent task preempts a less urgent one wherever it is, also inside numpy."""

from __future__ import annotations

import itertools
import os
import shutil
import statistics
import tempfile
from pathlib import Path

import pytest
from plain_dispatcher.dispatch import replay
from reference import Reference
from rt_rig import CORE, MS, NOBODY, Host

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Decision
from pbonet.node.rt import _rt

ABOVE_ALL = 90
"""A level of the reference loop above all tasks, and below the dispatcher."""
needs_fifo = pytest.mark.skipif(
    not _rt.probe().fifo, reason="; ".join(_rt.probe().reasons)
)


@pytest.fixture
def start():
    started, folders = [], []

    def one(backend, uid=-1):
        folders.append(Path(tempfile.mkdtemp(prefix="pbonet-rt-")))
        if uid > 0:
            os.chown(folders[-1], uid, uid)
        started.append(Host(folders[-1], backend, uid=uid))
        return started[-1]

    yield one
    for host in started:
        host.close()
    for folder in folders:
        shutil.rmtree(folder)


@needs_fifo
@pytest.mark.parametrize(
    ("body", "args"), [("matmul", {"size": 900}), ("busy", {"ns": 40 * MS})]
)
def test_an_earlier_deadline_preempts(start, body, args) -> None:
    """One multiplication is one C call; cycles of the other task fall amid it."""
    host = start("fifo")
    slow = host.spawn(body, args, period_ns=250 * MS, crit=5)
    fast = host.spawn("idle", period_ns=3 * MS, crit=5)
    with Reference(CORE, ABOVE_ALL) as reference:
        slow.until("cycles", 6)
        fast.end()
        slow.end()
        away = reference.away()
    long = [(start, end) for _, _, start, end, _ in slow.records()]
    short = [(start, end) for _, _, start, end, _ in fast.records()]
    for begin, end in long[1:-1]:
        stood = sum(max(0, min(ran, end) - max(due, begin)) for due, ran in away)
        periods = (end - begin - stood) // (3 * MS)
        amid = sum(begin < s and e < end for s, e in short)
        assert periods >= 3, "the slow cycle was too short to show anything"
        assert amid >= periods // 2


@needs_fifo
def test_a_higher_criticality_runs_first_whatever_the_deadlines(start) -> None:
    host = start("fifo")
    slow = host.spawn("busy", {"ns": 12 * MS}, period_ns=40 * MS, crit=6)
    fast = host.spawn("busy", {"ns": MS}, period_ns=5 * MS, crit=3)
    slow.until("cycles", 15)
    fast.end()
    slow.end()
    long = [(start, end) for _, _, start, end, _ in slow.records()]
    amid = [
        s
        for _, _, s, _, _ in fast.records()
        if any(begin < s < end - MS for begin, end in long)
    ]
    assert amid == []
    assert fast.status()["missed"] >= 15


def progress_amid(low_notes, high_records) -> tuple[int, int]:
    """Return how many notes fall within the other's cycles, and how many do not.

    The dispatcher, which has no right of way here, is given half a cycle to come.
    """
    amid = 0
    for _, _, start, end, _ in high_records:
        amid += sum((start + end) // 2 < at < end for at in low_notes)
    return amid, len(low_notes) - amid


def park_scenario(host) -> None:
    assert host.backend() == "park"
    low = host.spawn("stamps", {"ns": 30 * MS}, period_ns=200 * MS, crit=3)
    high = host.spawn("busy", {"ns": 4 * MS}, period_ns=10 * MS, crit=5)
    low.until("cycles", 6)
    high.until("cycles", 60)
    lost, records = host.trace()
    assert lost == 0
    assert os.sched_getscheduler(high.pid) == os.SCHED_OTHER
    notes = low.end()["notes"]
    high.end()
    trace = [Decision(*r) for r in records]
    kinds = [record.kind for record in trace]
    assert kinds.count(Event.PARK) >= 6
    assert kinds.count(Event.RESUME) >= 5
    assert replay(trace) > 60
    amid, apart = progress_amid(notes, high.records())
    assert apart > 0
    assert amid < 0.1 * apart, "the loser went on while the winner ran"


def test_park_really_stops_the_loser(start) -> None:
    park_scenario(start("park"))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
def test_park_works_for_an_unprivileged_user(start) -> None:
    host = start("auto", NOBODY)
    park_scenario(host)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
def test_park_waits_for_no_event_when_a_cycle_ends(start) -> None:
    """The next task goes on at once: the end of a cycle is news under park."""
    host = start("auto", NOBODY)
    tasks = [
        host.spawn("busy", {"ns": 2 * MS}, period_ns=400 * MS, crit=5, priority=k)
        for k in range(3)
    ]
    for task in tasks:
        task.until("cycles", 4)
    for task in tasks:
        task.end()
    rounds: dict[int, list[tuple[int, int]]] = {}
    for task in tasks:
        for _, release, begin, end, _ in task.records():
            rounds.setdefault(release, []).append((begin, end))
    whole = [sorted(r) for r in rounds.values() if len(r) == 3]
    assert whole
    for cycles in whole:
        for (_, end), (begin, _) in itertools.pairwise(cycles):
            assert begin >= end
    spans = [cycles[-1][0] - cycles[0][0] for cycles in whole]
    assert statistics.median(spans) < 300 * MS, "each waited for the next event"
