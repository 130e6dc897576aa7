"""The sole ready task of a core releases itself; nothing else changes by that."""

from __future__ import annotations

import itertools

import pytest
from plain_dispatcher.dispatch import replay
from rt_rig import MS, Host, until

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Decision
from pbonet.node.rt import _rt

pytestmark = pytest.mark.skipif(
    not _rt.probe().fifo, reason="; ".join(_rt.probe().reasons)
)


@pytest.fixture
def host(tmp_path):
    host = Host(tmp_path)
    yield host
    host.close()


class Trace:
    """All records of the dispatcher from the beginning on."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._records: list[Decision] = []

    def read(self) -> list[Decision]:
        lost, records = self._host.trace()
        assert lost == 0
        self._records += [Decision(*record) for record in records]
        return self._records

    def taken(self) -> int:
        """Return how many releases tasks have taken themselves."""
        return sum(r.arg for r in self.read() if r.kind == Event.DONE)


@pytest.fixture
def trace(host) -> Trace:
    return Trace(host)


def test_its_cycles_cost_no_turns_and_every_release_has_one(host, trace) -> None:
    task = host.spawn("idle", period_ns=2 * MS, crit=5)
    task.until("cycles", 20)
    until(lambda: trace.taken() > 150, "it has released itself")
    task.end()
    status = task.status()
    releases = [record[1] for record in task.records()]
    assert all(at % (2 * MS) == 0 for at in releases)
    _assert_each_once(releases, 2 * MS, status["missed"])
    assert replay(trace.read())


def test_a_late_cycle_is_missed_as_under_the_dispatcher(host, trace) -> None:
    """Every fifth cycle takes two and a half periods: it uses up two releases."""
    task = host.spawn("overrun", {"every": 5, "ns": 10 * MS}, period_ns=4 * MS, crit=5)
    task.until("cycles", 50)
    task.end()
    releases = [record[1] for record in task.records()]
    steps = {(b - a) // (4 * MS) for a, b in itertools.pairwise(releases)}
    assert {1, 3} <= steps
    status = task.status()
    assert status["missed"] >= 2 * (status["cycles"] // 5)
    assert status["failures"][0] >= status["cycles"] // 5
    assert replay(trace.read())


def test_its_reserve_is_kept_to_the_instant(host, trace) -> None:
    task = host.spawn(
        "overrun", {"every": 7, "ns": 6 * MS},
        period_ns=10 * MS, crit=5, drop=3, maxc_ns=2 * MS,
    )  # fmt: skip
    task.until("cycles", 60)
    task.end()
    assert task.status()["overruns"] >= task.status()["cycles"] // 7
    records = trace.read()
    used = [
        (record.a, mark.a if mark.kind == Event.USED else mark.b)
        for mark, record in _reserves(records)
    ]
    assert used
    assert all(2 * MS <= now - mark <= 3 * MS for now, mark in used)
    assert replay(records)


def _reserves(records: list[Decision]) -> list[tuple[Decision, Decision]]:
    """Return the CPU clock at a cycle's release and at the end of its reserve."""
    mark = last = None
    found = []
    for record in records:
        if record.kind == Event.DONE and record.arg:
            mark = record
        elif record.kind == Event.USED:
            last = record
        elif record.kind == Event.RELEASE:
            mark = last
        elif record.kind == Event.CRIT and record.arg == 3:
            found.append((mark, last))
    return found


def test_tasks_whose_releases_are_apart_release_themselves(host, trace) -> None:
    """The dispatcher takes a turn where two releases meet, and when a lease ends."""
    periods = [4 * MS, 5 * MS, 7 * MS]
    tasks = [host.spawn("idle", period_ns=p, crit=5) for p in periods]
    for task in tasks:
        task.until("cycles", 20)
    until(lambda: trace.taken() > 300, "they have released themselves")
    for task in tasks:
        task.end()
    assert {r.slot for r in trace.read() if r.kind == Event.DONE and r.arg} == {
        task.slot for task in tasks
    }
    for task, period in zip(tasks, periods, strict=True):
        releases = [record[1] for record in task.records()]
        assert all(at % period == 0 for at in releases)
        _assert_each_once(releases, period, task.status()["missed"])
    assert replay(trace.read())


def test_a_more_urgent_task_interrupts_a_cycle_of_a_lease(host, trace) -> None:
    """It is ranked by a turn at its release, not when the other cycle has ended."""
    slow = host.spawn("busy", {"ns": 20 * MS}, period_ns=50 * MS, crit=3)
    slow.until("cycles", 3)
    quick = host.spawn("idle", period_ns=7 * MS, crit=5)
    quick.until("cycles", 100)
    until(lambda: trace.taken() > 50, "they have released themselves")
    quick.end()
    slow.end()
    status = quick.status()
    _assert_each_once([r[1] for r in quick.records()], 7 * MS, status["missed"])
    ranked = [
        r for r in trace.read() if r.kind == Event.RELEASE and r.slot == quick.slot
    ]
    assert len(ranked) > status["cycles"] // 5
    assert replay(trace.read())


def test_a_late_cycle_beside_others_is_a_failure(host, trace) -> None:
    late = host.spawn(
        "overrun", {"every": 5, "ns": 8 * MS},
        period_ns=11 * MS, deadline_ns=3 * MS, crit=4,
    )  # fmt: skip
    others = [host.spawn("idle", period_ns=p, crit=5) for p in (4 * MS, 7 * MS)]
    late.until("cycles", 60)
    for task in (late, *others):
        task.end()
    status = late.status()
    assert status["failures"][0] >= status["cycles"] // 5
    assert trace.taken() > 60
    assert replay(trace.read())


def _assert_each_once(releases: list[int], period: int, missed: int) -> None:
    steps = [(b - a) // period for a, b in itertools.pairwise(releases)]
    assert all(step > 0 for step in steps)
    assert sum(step - 1 for step in steps) <= missed


@pytest.mark.parametrize("periods", [[2 * MS], [4 * MS, 5 * MS, 7 * MS]])
def test_they_go_on_while_their_leader_is_replaced(tmp_path, periods) -> None:
    leader = Host(tmp_path)
    until(leader.leading, "the first host leads")
    standby = Host(tmp_path)
    try:
        tasks = [standby.spawn("idle", period_ns=p, crit=5) for p in periods]
        for task in tasks:
            task.until("cycles", 60)
        leader.kill()
        until(standby.leading, "the standby leads")
        for task in tasks:
            task.until("cycles", task.status()["cycles"] + 60)
        for task in tasks:
            task.end()
        for task, period in zip(tasks, periods, strict=True):
            releases = [record[1] for record in task.records()]
            _assert_each_once(releases, period, task.status()["missed"])
    finally:
        leader.close()
        standby.close()
