"""A task that is alone on its core releases itself; nothing else changes by that."""

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
    steps = [b - a for a, b in itertools.pairwise(releases)]
    assert all(step > 0 for step in steps)
    assert sum(step // (2 * MS) - 1 for step in steps) <= status["missed"]
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


def test_a_second_task_ends_the_lease_and_both_have_their_releases(host, trace) -> None:
    lone = host.spawn("idle", period_ns=2 * MS, crit=5)
    lone.until("cycles", 50)
    other = host.spawn("busy", {"ns": MS}, period_ns=5 * MS, crit=5)
    other.until("cycles", 20)
    before = trace.taken()
    cycles = lone.status()["cycles"]
    lone.until("cycles", cycles + 100)
    assert trace.taken() == before
    other.end()
    until(lambda: trace.taken() > before + 20, "it is alone again")
    lone.end()
    releases = [record[1] for record in lone.records()]
    assert len(set(releases)) == len(releases)
    assert replay(trace.read())


def test_it_goes_on_while_its_leader_is_replaced(tmp_path) -> None:
    leader = Host(tmp_path)
    until(leader.leading, "the first host leads")
    standby = Host(tmp_path)
    try:
        task = standby.spawn("idle", period_ns=2 * MS, crit=5)
        task.until("cycles", 100)
        leader.kill()
        until(standby.leading, "the standby leads")
        cycles = task.status()["cycles"]
        task.until("cycles", cycles + 100)
        task.end()
        releases = [record[1] for record in task.records()]
        assert len(set(releases)) == len(releases)
        missing = (releases[-1] - releases[0]) // (2 * MS) + 1 - len(releases)
        assert missing <= task.status()["missed"]
    finally:
        leader.close()
        standby.close()
