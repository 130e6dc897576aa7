"""Deaths of every kind: tasks, leaders, hosts; siblings and slots survive them."""

from __future__ import annotations

import os
import random
import signal
import time

import pytest
from plain_dispatcher.dispatch import replay
from rt_rig import CORE, MS, Host, exists, until

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Decision
from pbonet.node.rt import _rt


@pytest.fixture
def hosts(tmp_path):
    started: list[Host] = []

    def start(backend="auto"):
        started.append(Host(tmp_path, backend))
        return started[-1]

    yield start
    for host in started:
        host.close()


@pytest.fixture
def table_path(tmp_path):
    return tmp_path / f"pbonet.{os.geteuid()}.core{CORE}"


def test_killed_tasks_do_not_disturb_their_siblings(hosts) -> None:
    host, pick = hosts(), random.Random(1)
    tasks = [
        host.spawn("busy", {"ns": MS // 4}, period_ns=8 * MS, priority=k)
        for k in range(8)
    ]
    for task in tasks:
        task.until("cycles", 5)
    pick.shuffle(tasks)
    while len(tasks) > 1:
        victim = tasks.pop()
        os.kill(victim.pid, signal.SIGKILL)
        assert host.wait(pid=victim.pid) == -signal.SIGKILL
        host.free(slot=victim.slot)  # as an RTPU process does; `park` needs to be told
        for task in tasks:
            task.until("cycles", task.status()["cycles"] + 3)
    notes = tasks[0].end()
    assert notes["levels"]


def test_the_dispatcher_finds_a_death_by_itself(hosts) -> None:
    """The kernel answers ESRCH to a change of level, and nobody called `died`."""
    host = hosts("fifo") if _rt.probe().fifo else pytest.skip("needs SCHED_FIFO")
    tasks = [
        host.spawn("busy", {"ns": MS // 5}, period_ns=p * MS) for p in (4, 5, 7, 9)
    ]
    for task in tasks:
        task.until("cycles", 5)
    for task in tasks[:2]:
        os.kill(task.pid, signal.SIGKILL)
        host.wait(pid=task.pid)
    host.configure(slot=tasks[0].slot, pid=tasks[1].pid)  # gone as well: a new level
    until(lambda: tasks[0].status()["dead"], "the slot is marked dead")
    assert tasks[0].status()["errors"] >= 1
    tasks[2].until("cycles", tasks[2].status()["cycles"] + 20)


def test_a_standby_takes_over_and_no_slot_is_lost(hosts) -> None:
    leader = hosts()
    until(leader.leading, "the first host leads")
    standby = hosts()
    tasks = [standby.spawn("idle", period_ns=p * MS) for p in (2, 3, 5, 10)]
    others = [leader.spawn("idle", period_ns=p * MS) for p in (2, 7)]
    for task in tasks + others:
        task.until("cycles", 20)
    assert not standby.leading()
    before = [task.status() for task in tasks]
    leader.kill()
    until(standby.leading, "the standby leads")
    for task, was in zip(tasks, before, strict=True):
        now = task.until("cycles", was["cycles"] + 50)
        assert now["on_ns"] == was["on_ns"], "the task had to arm again"
    for task in others:
        until(lambda pid=task.pid: not exists(pid), "the orphan ends")
    assert standby.core_status()["takeovers"] == 1
    assert standby.core_status()["leader_pid"] == standby.process.pid
    for task in tasks:
        task.end()
    extra = standby.spawn("idle", period_ns=5 * MS)
    names = {task.slot for task in tasks} | {extra.slot}
    assert set(standby.slots()) == names, "slots of the dead host are reclaimed"


def test_releases_across_a_takeover_are_granted_or_counted(hosts) -> None:
    leader, standby = hosts(), hosts()
    first, second = (leader, standby) if leader.leading() else (standby, leader)
    task = second.spawn("idle", period_ns=MS)
    task.until("cycles", 100)
    first.kill()
    until(second.leading, "the standby leads")
    task.until("cycles", task.status()["cycles"] + 200)
    task.end()
    records, status = task.records(), task.status()
    first, last = records[0][1], records[-1][1]
    within = (last - first) // MS + 1 - len(records)
    around = (first - status["on_ns"] + time.monotonic_ns() - last) // MS + 1
    assert within <= status["missed"] <= within + around
    releases = [r[1] for r in records]
    assert releases == sorted(set(releases))


def test_the_trace_goes_on_across_takeovers(hosts) -> None:
    keeper = hosts()
    until(keeper.leading, "the keeper leads")
    tasks = [keeper.spawn("busy", {"ns": MS // 5}, period_ns=p * MS) for p in (2, 3, 5)]
    trace: list[Decision] = []

    def drain() -> None:
        lost, records = keeper.trace()
        assert lost == 0
        trace.extend(Decision(*r) for r in records)

    for _ in range(3):
        other = hosts()
        keeper.stop_dispatcher()
        until(other.leading, "the other one leads")
        tasks[0].until("cycles", tasks[0].status()["cycles"] + 100)
        keeper_again = hosts()
        other.kill()
        until(keeper_again.leading, "the third one leads")
        tasks[0].until("cycles", tasks[0].status()["cycles"] + 100)
        drain()
        keeper = tasks[0].host
        keeper_again.end()
    drain()
    assert sum(record.kind == Event.LEAD for record in trace) >= 6
    assert replay(trace) > 300


def test_orphans_end_whatever_they_are_doing(hosts) -> None:
    host = hosts()
    good = host.spawn("idle", period_ns=5 * MS)
    slow = host.spawn("idle", period_ns=3_600_000 * MS)
    hung = host.spawn("hang", period_ns=3_600_000 * MS)
    good.until("cycles", 10)
    pids = [good.pid, slow.pid, hung.pid]
    host.kill()
    for pid in pids:
        until(lambda pid=pid: not exists(pid), f"task {pid} ends")


def test_a_hung_cycle_is_ended_by_the_alarm(hosts) -> None:
    """The next host finds the table stale, for its only member was killed."""
    host = hosts()
    hung = host.spawn("hang", period_ns=20 * MS)
    until(lambda: hung.status()["release_ns"] > 0, "the cycle began")
    host.kill()
    until(lambda: not exists(hung.pid), "the hung task ends")
    fresh = hosts()
    assert fresh.slots() == []
    fresh.spawn("idle", period_ns=5 * MS).until("cycles", 5)


def test_the_last_member_removes_the_table(hosts, table_path) -> None:
    one, two = hosts(), hosts()
    assert table_path.stat().st_mode & 0o777 == 0o600
    one.close()
    assert table_path.exists()
    two.close()
    assert not table_path.exists()


def test_sixty_four_tasks_on_one_core(hosts) -> None:
    host = hosts()
    tasks = [host.spawn("idle", period_ns=50 * MS, priority=k) for k in range(64)]
    for task in tasks:
        task.until("cycles", 5)
    levels = [task.status()["level"] for task in tasks]
    if host.backend() == "fifo":
        assert len(set(levels)) == 64
        assert all(4 <= level <= 84 for level in levels)
        kernel = [os.sched_getparam(task.pid).sched_priority for task in tasks]
        assert kernel == levels
        ordered = [task.status()["level"] for task in tasks]
        assert ordered == sorted(ordered)
    for task in tasks:
        task.end()
    assert sum(task.status()["errors"] for task in tasks) == 0
