"""The virtual core: Figure 6.1, misses, soft tasks; worked by hand."""

import json

import pytest

from pbonet.analysis.schedule.criticality import Timing, edf, muf, rate_monotonic
from pbonet.analysis.schedule.outcome import distribution
from pbonet.analysis.schedule.simulate import Core, PeriodicTask, simulate
from pbonet.analysis.schedule.urgency import NEVER

MS = 1_000_000
SET = {"t1": (6, 2), "t2": (10, 4), "t3": (12, 3), "t4": (15, 4)}
TIMINGS = [Timing(name=n, period=t, maxc=c) for n, (t, c) in SET.items()]
RULES = {
    "MUF": muf(TIMINGS),
    "EDF": edf(TIMINGS),
    "RM": rate_monotonic(TIMINGS, 0.05, 0.5),
}


def figure_6_1(rule: str, until: int):
    tasks = [
        PeriodicTask(
            name=name,
            period_ns=period * MS,
            cost=cost * MS,
            crit=RULES[rule][name].crit,
        )
        for name, (period, cost) in SET.items()
    ]
    return simulate(tasks, until_ns=until * MS)


@pytest.mark.parametrize(
    ("rule", "late"), [("RM", {"t3", "t4"}), ("EDF", {"t1", "t2"}), ("MUF", {"t4"})]
)
@pytest.mark.parametrize("until", [24, 36, 48])
def test_figure_6_1_exactly_these_tasks_miss(rule: str, late: set, until: int) -> None:
    assert figure_6_1(rule, until).missing == late


def test_figure_6_1_over_twelve_hyperperiods() -> None:
    assert figure_6_1("MUF", 720).missing == {"t4"}
    assert figure_6_1("RM", 720).missing == {"t3", "t4"}
    assert {"t1", "t2"} < figure_6_1("EDF", 720).missing


def test_the_first_slices_of_figure_6_1_under_rm() -> None:
    segments = figure_6_1("RM", 20).segments
    assert [(s.task, s.start_ns // MS, s.end_ns // MS) for s in segments] == [
        ("t1", 0, 2), ("t2", 2, 6), ("t1", 6, 8), ("t3", 8, 10), ("t2", 10, 12),
        ("t1", 12, 14), ("t2", 14, 16), ("t3", 16, 17), ("t4", 17, 18), ("t1", 18, 20),
    ]  # fmt: skip


def test_a_late_cycle_goes_on_and_its_period_is_the_missed_one() -> None:
    costs = iter([7, 2, 2, 2])
    task = PeriodicTask(name="a", period_ns=5, cost=lambda: next(costs))
    account = simulate([task], until_ns=20).tasks["a"]
    assert account.releases == 5
    assert account.cycles == 3
    assert (account.missed, account.late) == (1, 1)
    assert account.misses_ns == [5]
    assert account.first_miss_ns == 5
    assert account.responses_ns == [7, 2, 2]


def test_a_cycle_that_has_not_begun_is_dropped_for_the_newer_one() -> None:
    hog = PeriodicTask(name="hog", period_ns=100, cost=12, crit=6)
    task = PeriodicTask(name="a", period_ns=10, cost=3)
    account = simulate([hog, task], until_ns=20).tasks["a"]
    assert account.missed == 1
    assert account.late == 0
    assert account.responses_ns == [5]


def test_a_cycle_that_ends_with_its_deadline_is_in_time() -> None:
    outcome = simulate([PeriodicTask(name="a", period_ns=5, cost=5)], until_ns=50)
    assert outcome.missing == set()
    assert outcome.tasks["a"].cycles == 10
    assert outcome.utilization == 1.0


def test_a_deadline_before_the_next_release_counts_late_cycles_only() -> None:
    task = PeriodicTask(name="a", period_ns=10, cost=6, deadline_ns=5)
    account = simulate([task], until_ns=20).tasks["a"]
    assert (account.missed, account.late, account.first_miss_ns) == (0, 2, 5)
    assert account.misses


def test_priority_decides_between_equal_deadlines_then_first_come() -> None:
    low = PeriodicTask(name="low", period_ns=10, cost=2)
    high = PeriodicTask(name="high", period_ns=10, cost=2, priority=1)
    same = PeriodicTask(name="same", period_ns=10, cost=2)
    segments = simulate([low, high, same], until_ns=9).segments
    assert [segment.task for segment in segments] == ["high", "low", "same"]


def test_a_cycle_without_cost_ends_at_once() -> None:
    task = PeriodicTask(name="a", period_ns=5, cost=0)
    account = simulate([task], until_ns=10).tasks["a"]
    assert account.responses_ns == [0, 0]


def test_a_cycle_is_not_begun_when_its_least_time_cannot_be_granted() -> None:
    """Section 6.3, the third kind: others get the time at once."""
    hog = PeriodicTask(name="hog", period_ns=100, cost=6, crit=6)
    late = PeriodicTask(name="late", period_ns=10, cost=6, least_ns=5)
    other = PeriodicTask(name="other", period_ns=100, cost=4, crit=3)
    outcome = simulate([hog, late, other], until_ns=20)
    account = outcome.tasks["late"]
    assert (account.missed, account.given_up, account.first_miss_ns) == (1, 1, 6)
    assert account.responses_ns == [6]
    assert outcome.tasks["other"].responses_ns == [10]
    just = PeriodicTask(name="late", period_ns=10, cost=4, least_ns=4)
    assert simulate([hog, just], until_ns=20).missing == set()


def test_offsets_shift_the_grid() -> None:
    task = PeriodicTask(name="a", period_ns=10, cost=1, offset_ns=13)
    assert simulate([task], until_ns=30).tasks["a"].releases_ns == [3, 13, 23]
    later = simulate([task], until_ns=30, start_ns=14)
    assert later.tasks["a"].releases_ns == [23]


def test_a_soft_task_gives_way_when_its_reserve_is_used_up() -> None:
    """T 12, C 10, E 6 of section 6.4, beside a task that needs the rest."""
    soft = PeriodicTask(name="soft", period_ns=12, cost=10, effective_ns=6)
    hard = PeriodicTask(name="hard", period_ns=12, cost=6)
    outcome = simulate([soft, hard], until_ns=48)
    assert outcome.missing == {"soft"}
    account = outcome.tasks["soft"]
    assert account.cycles == 2
    assert account.misses_ns == [12, 36]
    assert account.overruns == 2
    assert {(s.task, s.crit) for s in outcome.segments} == {("soft", 5), ("hard", 5)}


def test_a_soft_task_makes_use_of_what_is_left_over() -> None:
    soft = PeriodicTask(name="soft", period_ns=12, cost=10, effective_ns=6)
    hard = PeriodicTask(name="hard", period_ns=12, cost=2)
    outcome = simulate([soft, hard], until_ns=48)
    assert outcome.missing == set()
    assert [(s.task, s.crit, s.end_ns - s.start_ns) for s in outcome.segments[:3]] == [
        ("soft", 5, 6), ("hard", 5, 2), ("soft", 3, 4)
    ]  # fmt: skip


def test_the_same_run_twice_is_the_same() -> None:
    first, second = figure_6_1("EDF", 240), figure_6_1("EDF", 240)
    assert first.as_data() == second.as_data()


def test_time_may_pass_in_pieces() -> None:
    tasks = [PeriodicTask(name=n, period_ns=t, cost=c) for n, (t, c) in SET.items()]
    core = Core(tasks)
    for until in range(0, 121, 7):
        core.run_until(until)
    core.run_until(120)
    whole = simulate(tasks, until_ns=120)
    assert core.outcome().tasks == whole.tasks


def test_without_segments_the_counts_are_the_same() -> None:
    tasks = [PeriodicTask(name=n, period_ns=t, cost=c) for n, (t, c) in SET.items()]
    kept = simulate(tasks, until_ns=600)
    bare = simulate(tasks, until_ns=600, keep=False)
    assert bare.segments == []
    for name, account in kept.tasks.items():
        other = bare.tasks[name]
        assert (account.missed, account.late) == (other.missed, other.late)
        assert account.responses_ns == other.responses_ns


def test_an_outcome_as_a_table_and_as_json() -> None:
    outcome = figure_6_1("MUF", 60)
    rows = [line.split() for line in outcome.as_text().splitlines()]
    assert [" ".join(row) for row in rows] == [
        "task crit releases cycles missed late CPU % min p50 p99 max ms",
        "t1 5 11 10 0 0 33.3 2.000 3.000 5.000 5.000",
        "t2 5 7 6 0 0 40.0 6.000 7.000 8.000 8.000",
        "t3 5 6 5 0 0 25.0 5.000 7.000 9.000 9.000",
        "t4 3 5 0 4 0 1.7 - - - -",
    ]
    assert len({len(line) for line in outcome.as_text().splitlines()}) == 1
    data = json.loads(json.dumps(outcome.as_data()))
    assert data["missing"] == ["t4"]
    assert data["tasks"]["t4"]["responses"] is None
    assert data["tasks"]["t1"]["responses"]["max_ns"] == 5 * MS
    assert data["segments"][0] == ["t1", 0, 2 * MS, 5]
    assert outcome.as_data(segments=False)["segments"] == []


def test_the_distribution_of_response_times() -> None:
    assert distribution([]) is None
    spread = distribution(list(range(1, 101)))
    assert spread is not None
    assert (spread.p50_ns, spread.p90_ns, spread.p99_ns) == (50, 90, 99)
    assert (spread.min_ns, spread.max_ns, spread.mean_ns) == (1, 100, 50.5)
    assert sum(count for _, count in spread.bins) == spread.count == 100


@pytest.mark.parametrize(
    ("tasks", "text"),
    [
        ([("a", 5, 1), ("a", 5, 1)], "two tasks are named a"),
        ([("a", 0, 1)], "a: a period is above zero"),
        ([("a", 5, -1)], "a: a period is above zero"),
    ],
)
def test_what_cannot_be_simulated_is_refused(tasks: list, text: str) -> None:
    made = [PeriodicTask(name=n, period_ns=t, cost=c) for n, t, c in tasks]
    with pytest.raises(ValueError, match=text):
        simulate(made, until_ns=10)


def test_ranges_are_those_of_the_runtime() -> None:
    with pytest.raises(ValueError, match="criticality 64 is not within"):
        simulate([PeriodicTask(name="a", period_ns=5, cost=1, crit=64)], until_ns=9)
    with pytest.raises(ValueError, match="time cannot begin at -1 ns"):
        simulate([], until_ns=9, start_ns=-1)


def test_step_by_step_is_the_same_as_all_at_once() -> None:
    """Several cores go in step by `next_ns`; a step must not change the schedule."""
    tasks = [
        PeriodicTask(name="a", period_ns=6, cost=2, crit=5),
        PeriodicTask(name="b", period_ns=10, cost=4, crit=5, effective_ns=3),
        PeriodicTask(name="c", period_ns=15, cost=4, crit=3, least_ns=2),
    ]
    whole = simulate(tasks, until_ns=300)
    core = Core(tasks)
    last = 0
    while (soon := core.next_ns()) <= 300:
        assert soon >= last
        last = soon
        core.step()
    core.run_until(300)
    assert core.outcome() == whole


def test_a_task_that_is_stopped_is_released_no_more() -> None:
    begun: list[tuple[int, int]] = []
    ended: list[int] = []
    first = PeriodicTask(name="a", period_ns=4, cost=2)
    second = PeriodicTask(
        name="b",
        period_ns=10,
        cost=3,
        begun=lambda *at: begun.append(at),
        done=ended.append,
    )
    core = Core([first, second])
    core.run_until(14)
    core.stop("b")
    core.run_until(100)
    assert begun == [(2, 0), (10, 10)]
    assert ended == [7]
    outcome = core.outcome()
    assert outcome.tasks["b"].releases == 2
    assert outcome.tasks["a"].cycles == 25
    assert core.next_ns() == 100  # where the next cycle is about to begin
    core.stop("a")
    core.run_until(200)
    assert core.next_ns() == NEVER
