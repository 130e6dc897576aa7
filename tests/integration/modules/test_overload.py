"""Figure 6.1 of the thesis for real: who misses in an overload (Stewart 1994, 6.2.3).

Nothing here rests on the wall clock alone. The trace must be what the rules decide; who
had the core must have been the most urgent one, by CPU time too; and a task that misses
although it should not must have been deprived of the core, by the kernel's count of CPU
time. Where a loop on the same core was late as well, a miss does not count.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest
from reference import Reference

from pbonet.analysis.schedule.simulate import PeriodicTask, simulate
from pbonet.config import read_any
from pbonet.errors import NodeError
from pbonet.node.rt import _rt

EXAMPLE = Path(__file__).parents[3] / "examples" / "overload"
BURSTS = 2
ABOVE_ALL = 90
"""The reference loop's level: above tasks, below the dispatcher."""
ALLOWED_NS = 300_000
"""What comes to a cycle's CPU time behind its last stamp, with room: 0.1 units."""
needs_fifo = pytest.mark.skipif(
    not _rt.probe().fifo, reason="; ".join(_rt.probe().reasons)
)


@pytest.fixture
def example(monkeypatch):
    """The example's modules, found as its demo finds them."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    import demo
    import judged

    yield demo, judged
    for name in ("demo", "judged", "seen"):
        sys.modules.pop(name, None)


def key(scheduler, period, one):
    """Return what a ready task is ranked by in section 6.2.3; the least goes first."""
    outside = one.spent or (scheduler == "MUF" and one.task == "tau4")
    by_rate = scheduler == "RM" and not one.spent
    return outside, period if by_rate else one.deadline_ns


def disorders(run, scheduler):
    """Return the turns in which the ready ones do not stand in that order."""
    found = []
    for turn in run.history.turns:
        keys = [
            key(scheduler, run.tasks[one.task].period_ns, one)
            for one in turn.ready
            if one.task in run.tasks
        ]
        conducted = [
            place for place, one in enumerate(turn.ready) if one.task == "pulse"
        ]
        if keys != sorted(keys) or conducted not in ([], [0]):
            found.append(turn)
    return found


def out_of_turn(run):
    """Return the cycles that began or ended while a more urgent one was there."""
    spans = {}
    for one in run.history.stretches:
        spans.setdefault((one.task, one.number), []).append(one)
    return [
        (task, number)
        for task, cycles in run.history.cycles.items()
        for number, cycle in enumerate(cycles, 1)
        for stamp in (cycle.start_ns, cycle.end_ns)
        if not any(
            one.begin_ns <= stamp <= one.end_ns for one in spans.get((task, number), [])
        )
    ]


def too_much(run):
    """Return the cycles with more CPU time than they had the core for."""
    granted = run.history.granted()
    return [
        (task, number, cycle.cpu_ns - granted[task, number])
        for task, cycles in run.history.cycles.items()
        for number, cycle in enumerate(cycles, 1)
        if cycle.cpu_ns > granted[task, number] + ALLOWED_NS
    ]


def recomputed(run, burst):
    """Return who misses in a burst whose cycles take the CPU time that they took."""
    begin, end = run.bursts[burst]

    def costs(name, reserve):
        for cycle in run.history.cycles[name]:
            if begin <= cycle.release_ns < end:
                yield min(cycle.cpu_ns, reserve)
        while True:
            yield reserve

    tasks = []
    for name, (_, units) in sys.modules["judged"].TASKS.items():
        status = run.tasks[name]
        taken = costs(name, units * sys.modules["judged"].UNIT_NS)
        tasks.append(
            PeriodicTask(
                name=name,
                period_ns=status.period_ns,
                cost=taken.__next__,
                crit=status.crit,
                priority=status.priority,
            )
        )
    return simulate(tasks, start_ns=begin, until_ns=end).missing


def whole_run(demo, scheduler):
    """Return a run in which a burst is whole; a machine that stalls may break all."""
    for _ in range(7):
        try:
            return demo.run(scheduler, BURSTS)
        except NodeError as error:
            if "no burst has run to its end" not in str(error):
                raise
    return demo.run(scheduler, BURSTS)


@needs_fifo
@pytest.mark.parametrize("scheduler", ["MUF", "RM", "EDF"])
def test_an_overload_hits_whom_it_may_hit(example, run_dir, scheduler):
    demo, judged = example
    assert run_dir.is_dir()
    with Reference(demo.core(), ABOVE_ALL) as reference:
        run = whole_run(demo, scheduler)  # which plays the trace through the rules
        away = reference.away()
    assert disorders(run, scheduler) == []
    assert out_of_turn(run) == []
    assert too_much(run) == []

    judgement = judged.judge(run.history, scheduler, run.bursts)
    assert judgement.idle == []
    unexplained = [
        miss
        for miss in judgement.misses
        if not miss.excused
        and not any(due < miss.deadline_ns and ran > miss.begin_ns for due, ran in away)
    ]
    assert unexplained == []
    for burst in range(len(run.bursts)):
        missing = recomputed(run, burst)
        assert missing.isdisjoint(judged.SAFE[scheduler])
        assert all(missing & set(group) for group in judged.BOUND[scheduler])
    crits = {name: status.crit for name, status in run.tasks.items()}
    if scheduler == "MUF":
        assert crits == {"tau1": 5, "tau2": 5, "tau3": 5, "tau4": 3}
    elif scheduler == "EDF":
        assert set(crits.values()) == {5}
        assert disorders(run, "MUF")  # or the order above would prove nothing
        assert disorders(run, "RM")
    else:
        assert sorted(crits.values(), reverse=True) == list(crits.values())
        assert len(set(crits.values())) == 4
        assert disorders(run, "EDF")


def test_the_files_say_what_the_judgement_rests_on(example):
    _, judged = example
    for name, (period, cost) in judged.TASKS.items():
        rmod = read_any(EXAMPLE / f"{name}.rmod")
        unit = judged.UNIT_NS * 1e-9
        assert rmod.freq == pytest.approx(1 / (period * unit))
        assert rmod.maxc == pytest.approx(cost * unit)
        (work,) = rmod.local["WORK"].words
        assert float(work) == pytest.approx(judged.SHARE * cost * unit)


def without_rights():
    """Take away what real time needs, from root too."""
    import ctypes

    sys_nice, drop = 23, 24
    ctypes.CDLL(None).prctl(drop, sys_nice, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))


def test_without_rights_it_says_what_is_missing():
    done = subprocess.run(
        [sys.executable, str(EXAMPLE / "demo.py"), "--quick"],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=without_rights,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert "this needs SCHED_FIFO, which the kernel refuses here" in done.stderr
    assert "rtprio" in done.stderr
    assert "pbonet doctor" in done.stderr
