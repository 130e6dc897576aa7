"""The virtual core: Figure 6.1 of the thesis, and small cases worked by hand."""

import pytest
from plain_dispatcher.dispatch import replay
from plain_dispatcher.inline import Inline

from pbonet.analysis.schedule.criticality import Timing, edf, muf, rate_monotonic

MS = 1_000_000
SET = {"t1": (6, 2), "t2": (10, 4), "t3": (12, 3), "t4": (15, 4)}
TIMINGS = [Timing(name=n, period=t, maxc=c) for n, (t, c) in SET.items()]


def core_of(crits, priority=None):
    core = Inline()
    for name, (period, cpu) in SET.items():
        core.add(
            name,
            lambda _now, _dt, cpu=cpu: cpu * MS,
            period_ns=period * MS,
            crit=crits[name].crit,
            priority=(priority or {}).get(name, 0),
        )
        core.on(name)
    core.run_until(720 * MS)
    return core


def missing(core):
    return {name for name, task in core.tasks.items() if core.missed(name) or task.late}


def test_figure_6_1_under_muf_only_the_fourth_task_misses() -> None:
    core = core_of(muf(TIMINGS))
    assert missing(core) == {"t4"}
    assert max(core.tasks["t3"].responses) == 9 * MS


def test_user_priority_decides_where_deadlines_are_equal() -> None:
    """At 66 ms t1 is released with the deadline (72 ms) that t3 has since 60 ms."""
    core = core_of(muf(TIMINGS), {"t1": 1})
    assert missing(core) == {"t4"}
    assert max(core.tasks["t3"].responses) == 11 * MS


def test_figure_6_1_under_rm_the_third_misses_too() -> None:
    assert missing(core_of(rate_monotonic(TIMINGS, 0.05, 0.5))) == {"t3", "t4"}


def test_figure_6_1_under_edf_critical_tasks_miss() -> None:
    assert missing(core_of(edf(TIMINGS))) & {"t1", "t2"}


def test_the_virtual_run_leaves_a_trace_like_the_native_one() -> None:
    core = core_of(muf(TIMINGS))
    ended = sum(task.cycles + core.missed(name) for name, task in core.tasks.items())
    under_way = sum(core._state(task).ready for task in core.tasks.values())
    assert replay(core.trace) == ended + under_way


def test_cpu_time_is_what_the_slices_say() -> None:
    core = core_of(muf(TIMINGS))
    for name, task in core.tasks.items():
        slices = [s for s in core.slices if s.task == name]
        assert sum(s.end_ns - s.start_ns for s in slices) == task.cpu_ns
    ends = [s.end_ns for s in core.slices]
    assert all(s.start_ns >= end for s, end in zip(core.slices[1:], ends, strict=False))


def test_an_earlier_deadline_preempts() -> None:
    core = Inline()
    core.add("slow", lambda _now, _dt: 8 * MS, period_ns=20 * MS)
    core.add("fast", lambda _now, _dt: 1 * MS, period_ns=5 * MS)
    core.on("slow")
    core.on("fast")
    core.run_until(40 * MS)
    runs = [(s.task, s.start_ns // MS, s.end_ns // MS) for s in core.slices]
    assert runs[3:7] == [
        ("fast", 20, 21), ("slow", 21, 25), ("fast", 25, 26), ("slow", 26, 30),
    ]  # fmt: skip


def test_user_priority_orders_equal_periods() -> None:
    order = []
    for first, second in (("a", "b"), ("b", "a")):
        core, seen = Inline(), []
        for name in "ab":
            core.add(
                name,
                lambda _now, _dt, name=name, seen=seen: seen.append(name) or 0,
                period_ns=10 * MS,
                priority=2 if name == first else 1,
            )
            core.on(name)
        core.run_until(35 * MS)
        assert seen == [first, second] * 3
        order.append(seen)
    assert order[0] != order[1]


def test_dt_spans_missed_cycles_and_none_is_caught_up() -> None:
    steps, takes = [], iter([1, 25, 1, 1, 1])
    core = Inline()

    def cycle(_now, dt):
        steps.append(round(dt * 1000))
        return next(takes) * MS

    core.add("a", cycle, period_ns=10 * MS)
    core.on("a")
    core.run_until(65 * MS)
    assert steps == [10, 10, 30, 10]
    assert core.missed("a") == 2
    assert core.tasks["a"].late == 1


def test_outputs_are_committed_when_the_cycle_ends() -> None:
    seen = []
    core = Inline()
    core.add("a", lambda _n, _d: 3 * MS, period_ns=10 * MS, finish=seen.append)
    core.on("a")
    core.run_until(20 * MS)
    assert seen == [13 * MS]


def test_off_drops_the_cycle_and_on_starts_afresh() -> None:
    core = Inline()
    core.add("a", lambda _n, _d: 6 * MS, period_ns=10 * MS)
    core.on("a")
    core.run_until(12 * MS)
    core.off("a")
    core.off("a")
    core.run_until(33 * MS)
    assert core.tasks["a"].cycles == 0
    core.on("a")
    core.run_until(55 * MS)
    assert core.tasks["a"].responses == [6 * MS]
    assert core.missed("a") == 0


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"period_ns": 0}, "period 0 ns is not above zero"),
        ({"period_ns": 5, "crit": 64}, "criticality 64 is not within 0 to 63"),
        ({"period_ns": 5, "priority": -1}, "user priority -1 is not within"),
    ],
)
def test_nonsense_is_refused(settings, text) -> None:
    with pytest.raises(ValueError, match=text):
        Inline().add("a", lambda _n, _d: 0, **settings)


def test_a_name_is_unique() -> None:
    core = Inline()
    core.add("a", lambda _n, _d: 0, period_ns=5)
    with pytest.raises(ValueError, match="task a is on the core already"):
        core.add("a", lambda _n, _d: 0, period_ns=5)
