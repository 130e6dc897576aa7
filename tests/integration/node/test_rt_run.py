"""Tasks under a real dispatcher: releases, order, misses, commands, accounting."""

from __future__ import annotations

import itertools
import os
import signal
import time

import pytest
from plain_dispatcher.dispatch import replay
from reference import Reference
from rt_rig import CORE, MS, Host, cpu_ns, until

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Decision
from pbonet.node.rt import _rt

FIFO = _rt.probe().fifo
ABOVE_ALL = 90
"""A level of the reference loop above all tasks, and below the dispatcher."""
needs_fifo = pytest.mark.skipif(not FIFO, reason="; ".join(_rt.probe().reasons))


@pytest.fixture
def host(tmp_path):
    host = Host(tmp_path)
    yield host
    host.close()
    left = [path.name for path in tmp_path.iterdir() if path.name.startswith("pbonet")]
    assert left == []


def test_every_cycle_has_its_own_release_on_the_grid(host) -> None:
    task = host.spawn("idle", period_ns=2 * MS, crit=5)
    task.until("cycles", 300)
    notes, records = task.end(), task.records()
    assert [r[0] for r in records] == list(range(1, len(records) + 1))
    releases = [r[1] for r in records]
    assert all(at % (2 * MS) == 0 for at in releases)
    assert releases == sorted(set(releases))
    assert all(start >= release for _, release, start, _, _ in records)
    assert all(end >= start for _, _, start, end, _ in records)
    assert notes["levels"] == [_rt.COMMAND_LEVEL if FIFO else 0]


def test_dt_is_the_distance_of_releases(host) -> None:
    task = host.spawn(
        "overrun", {"every": 7, "ns": 7 * MS}, order={"dts": True},
        period_ns=3 * MS, crit=5,
    )  # fmt: skip
    task.until("cycles", 60)
    dts, releases = task.end()["dts"], [r[1] for r in task.records()]
    assert dts[0] == pytest.approx(0.003)
    assert dts[1:] == pytest.approx([
        (b - a) * 1e-9 for a, b in itertools.pairwise(releases)
    ])
    assert max(dts) > 0.008


def test_an_overrun_is_missed_and_never_caught_up(host) -> None:
    task = host.spawn("overrun", {"every": 5, "ns": 7 * MS}, period_ns=3 * MS, crit=5)
    status = task.until("cycles", 50)
    task.end()
    records, status = task.records(), task.status()
    span = (records[-1][1] - records[0][1]) // (3 * MS) + 1
    assert status["missed"] >= 2 * (len(records) // 5)
    assert status["late"] >= len(records) // 5
    assert span - len(records) <= status["missed"]
    for a, b in itertools.pairwise(records):
        assert b[1] > a[3] - 3 * MS, "a release that had passed was run afterwards"
        assert b[2] >= a[3]


def test_equal_periods_run_in_the_order_of_user_priority(host) -> None:
    priorities = [2, 7, 1, 5]
    tasks = [
        host.spawn("busy", {"ns": MS // 5}, period_ns=20 * MS, crit=5, priority=p)
        for p in priorities
    ]
    for task in tasks:
        task.until("cycles", 30)
    for task in tasks:
        task.end()
    starts: dict[int, list[tuple[int, int]]] = {}
    for task, priority in zip(tasks, priorities, strict=True):
        for _, release, start, _, _ in task.records():
            starts.setdefault(release, []).append((start, priority))
    together = [
        [p for _, p in sorted(found)] for found in starts.values() if len(found) == 4
    ]
    assert len(together) >= 20
    assert together.count([7, 5, 2, 1]) >= 0.9 * len(together)


def test_a_new_period_takes_effect_at_the_next_release(host) -> None:
    task = host.spawn("idle", period_ns=10 * MS, crit=5)
    task.until("cycles", 10)
    host.configure(slot=task.slot, period_ns=4 * MS)
    task.until("cycles", 60)
    task.end()
    releases = [r[1] for r in task.records()]
    steps = [(b - a) // MS for a, b in itertools.pairwise(releases)]
    change = next(k for k, step in enumerate(steps) if step % 10)
    assert all(step % 10 == 0 for step in steps[:change])
    assert all(at % (4 * MS) == 0 for at in releases[change + 1 :])


def test_commands_come_between_cycles(host) -> None:
    task = host.spawn("busy", {"ns": MS}, order={"commands": 40}, period_ns=4 * MS)
    for _ in range(39):
        task.request()
        before = task.status()["cycles"]  # not earlier: the request may take a while
        task.until("cycles", before + 2)  # it has been obeyed by then
    notes = task.end()
    assert len(notes["levels"]) == 40
    assert set(notes["levels"]) == {_rt.COMMAND_LEVEL if FIFO else 0}
    assert task.status()["mode"] == 0


def test_off_and_on_again_starts_with_a_fresh_release(host) -> None:
    task = host.spawn(
        "idle", order={"commands": 5, "off_on": 0.03, "dts": True}, period_ns=5 * MS
    )
    with Reference(CORE, ABOVE_ALL) as reference:
        for count in range(1, 5):
            task.until("cycles", count * 5)
            before = task.status()["on_ns"]
            task.request()
            until(lambda b=before: task.status()["on_ns"] > b, "armed again")
        notes = task.end()
        lost = reference.lost(200.0)
    assert task.status()["missed"] <= lost or not FIFO
    dts = notes["dts"]
    assert dts.count(pytest.approx(0.005)) >= len(dts) - 20 - lost
    long = [dt for dt in dts if dt >= 0.03]
    assert len(long) <= lost or not FIFO  # else cycles may be missed


def test_cpu_time_is_the_kernels_own(host) -> None:
    task = host.spawn("busy", {"ns": MS}, period_ns=5 * MS, crit=5)
    task.until("cycles", 20)

    def look():
        """Return our figure between two of the kernel's: nobody stops for a look."""
        before = cpu_ns(task.pid)
        status = task.status()
        return before, status, cpu_ns(task.pid)

    begun, first, going = look()
    task.until("cycles", first["cycles"] + 100)
    still, last, over = look()
    ours = last["cpu_total_ns"] - first["cpu_total_ns"]
    assert 0.95 * (still - going) - 2 * MS <= ours <= 1.05 * (over - begun) + 2 * MS
    assert ours >= 99 * MS
    task.end()


def test_the_first_cycle_counts_for_neither_minimum_nor_maximum(host) -> None:
    args = {"first_ns": 8 * MS, "ns": MS // 2}
    task = host.spawn("first_long", args, period_ns=20 * MS, crit=5)
    status = task.until("cycles", 10)
    task.end()
    assert status["cpu_total_ns"] >= 12 * MS
    assert MS // 2 <= status["cpu_min_ns"] <= status["cpu_max_ns"] < 8 * MS
    assert 8 * MS <= status["cpu_first_ns"] < status["cpu_total_ns"]


def test_the_cycle_under_way_is_counted_before_it_ends(host) -> None:
    task = host.spawn("hang", period_ns=20 * MS, crit=5)
    used = [
        until(lambda at=at: task.status()["cpu_now_ns"] >= at, "so much is used")
        and task.status()["cpu_now_ns"]
        for at in (5 * MS, 50 * MS)
    ]
    assert used == sorted(used)
    assert task.status()["cycles"] == 0
    os.kill(task.pid, signal.SIGKILL)
    host.wait(pid=task.pid)


def test_a_stopped_task_is_counted_and_not_caught_up(host) -> None:
    task = host.spawn("idle", period_ns=2 * MS, crit=5)
    before = task.until("cycles", 20)["missed"] + 1  # one may be missed meanwhile
    os.kill(task.pid, signal.SIGSTOP)
    missed = task.until("missed", before + 100)["missed"]
    os.kill(task.pid, signal.SIGCONT)
    cycles = task.status()["cycles"]
    task.until("cycles", cycles + 20)
    task.end()
    assert missed >= 100
    releases = [r[1] for r in task.records()]
    gap = max(b - a for a, b in itertools.pairwise(releases))
    assert gap >= 100 * 2 * MS
    at = max(range(1, len(releases)), key=lambda k: releases[k] - releases[k - 1])
    after = task.status()
    assert releases[at] % (2 * MS) == 0
    assert after["missed"] >= missed


def test_a_stopped_host_leaves_one_release_and_a_count(host) -> None:
    task = host.spawn("idle", period_ns=2 * MS, crit=5)
    task.until("cycles", 20)
    os.kill(host.process.pid, signal.SIGSTOP)
    os.waitid(os.P_PID, host.process.pid, os.WSTOPPED | os.WNOWAIT)
    time.sleep(0.25)
    resumed = time.monotonic_ns()
    os.kill(host.process.pid, signal.SIGCONT)
    cycles = task.status()["cycles"]
    task.until("cycles", cycles + 20)
    task.end()
    releases = [r[1] for r in task.records()]
    first = next(k for k, at in enumerate(releases) if at >= resumed - 2 * MS)
    gap = releases[first] - releases[first - 1]
    # While it is alone the task has releases of up to 50 ms without its host.
    assert gap >= 190 * MS, "old releases were run after the stop"
    assert task.status()["missed"] >= 90


@needs_fifo
def test_a_real_run_replays_in_the_twin(host) -> None:
    """Over 10,000 releases, tasks going off and on, every decision found again."""
    tasks = [
        host.spawn(
            "random_busy", {"seed": k, "most_ns": MS},
            order={"commands": 10**6, "off_on": 0.002},
            period_ns=period, crit=3 + k % 3, priority=k,
            deadline_ns=period // 2 if k % 2 else 0,
        )
        for k, period in enumerate([MS, 2 * MS, 2 * MS, 3 * MS, 4 * MS, 5_333_333])
    ]  # fmt: skip
    trace: list[Decision] = []
    releases = 0
    pick = itertools.cycle(tasks)
    host.follow()
    while releases < 10_500:
        records = host.followed()
        trace += [Decision(*r) for r in records]
        releases += sum(r[0] == Event.RELEASE for r in records)
        next(pick).request()
        time.sleep(0.01)  # how often a task goes off
    for task in tasks:
        os.kill(task.pid, signal.SIGKILL)
        host.wait(pid=task.pid)
        host.free(slot=task.slot)
    trace += [Decision(*r) for r in host.followed()]
    assert replay(trace) >= 10_000
    kinds = {record.kind for record in trace}
    assert kinds >= {Event.MODE, Event.BEGUN, Event.MISS, Event.LEVEL, Event.LIFE}


def test_all_run_on_the_core_they_are_pinned_to(host) -> None:
    task = host.spawn("idle", period_ns=5 * MS)
    task.until("cycles", 3)
    assert os.sched_getaffinity(task.pid) == {CORE}
    task.end()


@pytest.mark.skipif(
    not _rt.probe().lock_memory, reason="the memlock limit is too small"
)
def test_a_settled_task_takes_no_page_faults(host) -> None:
    task = host.spawn("busy", {"ns": 50_000}, order={"settled": True}, period_ns=2 * MS)
    warm = task.until("cycles", 130)["faults"]
    last = task.until("cycles", 700)
    task.end()
    assert last["faults"] == warm


@needs_fifo
def test_a_process_named_after_the_task_was_armed_gets_its_level(host) -> None:
    """A task arms itself as soon as it is forked, before its pid is known here."""
    task = host.spawn("idle", period_ns=2 * MS)
    task.until("cycles", 5)
    assert os.sched_getscheduler(task.pid) == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    level = task.status()["level"]
    assert os.sched_getparam(task.pid).sched_priority == level > _rt.COMMAND_LEVEL
    task.end()
