"""Looks at running cycles: taken back when none runs, never missing when one does."""

from __future__ import annotations

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
def hosts(tmp_path):
    started = []

    def start() -> Host:
        started.append(Host(tmp_path))
        return started[-1]

    yield start
    for host in started:
        host.close()


def trace(host: Host) -> list[Decision]:
    lost, records = host.trace()
    assert lost == 0
    return [Decision(*record) for record in records]


def spared(host: Host) -> int:
    return host.core_status()["spared"]


def test_cycles_that_end_in_time_cost_no_turn(hosts) -> None:
    host = hosts()
    tasks = [
        host.spawn("idle", period_ns=5 * MS, crit=5, drop=3, maxc_ns=2 * MS)
        for _ in range(3)
    ]
    until(lambda: spared(host) >= 50, "looks are taken back")
    for task in tasks:
        task.end()
    assert all(task.status()["overruns"] == 0 for task in tasks)
    replay(trace(host))


def test_a_cycle_that_goes_on_is_looked_at(hosts) -> None:
    host = hosts()
    quick = host.spawn("idle", period_ns=10 * MS, crit=5, drop=3, maxc_ns=2 * MS)
    greedy = host.spawn(
        "busy", {"ns": 4 * MS}, period_ns=10 * MS, crit=5, drop=3, maxc_ns=2 * MS
    )
    greedy.until("cycles", 30)
    greedy.end()
    status = greedy.status()
    assert status["overruns"] >= status["cycles"]
    assert quick.status()["overruns"] == 0
    quick.end()
    drops = [r for r in trace(host) if (r.kind, r.arg) == (Event.CRIT, 3)]
    assert {record.slot for record in drops} == {greedy.slot}


def test_a_cycle_that_sleeps_is_looked_at_though_others_end(hosts) -> None:
    """The core has nothing to do then, but a deadline is to be told."""
    host = hosts()
    sleeper = host.spawn(
        "sleeps", {"ns": 6 * MS}, period_ns=10 * MS, deadline_ns=3 * MS, crit=5
    )
    idler = host.spawn("idle", period_ns=10 * MS, deadline_ns=3 * MS, crit=5)
    sleeper.until("cycles", 30)
    sleeper.end()
    idler.end()
    status = sleeper.status()
    assert status["failures"][0] >= status["cycles"]
    records = trace(host)
    replay(records)


def test_they_go_on_across_a_takeover(hosts) -> None:
    leader = hosts()
    until(leader.leading, "the first host leads")
    standby = hosts()
    task = standby.spawn("idle", period_ns=2 * MS, crit=5, drop=3, maxc_ns=MS)
    until(lambda: spared(standby) >= 20, "looks are taken back")
    leader.kill()
    until(standby.leading, "the standby leads")
    before = spared(standby)
    until(lambda: spared(standby) >= before + 20, "the new leader's are as well")
    task.end()
    assert task.status()["overruns"] == 0
