"""Schedulability tests for MUF, EDF and RM against the thesis and worked examples."""

import math

import pytest

from pbonet.analysis.schedule.analysis import (
    Demand,
    critical_set,
    edf_schedulable,
    largest_server,
    level_guaranteed,
    level_response_times,
    response_time,
    rm_bound_holds,
    rm_response_times,
    rm_schedulable,
    transform,
    utilization,
)
from pbonet.analysis.schedule.criticality import (
    Timing,
    liu_layland,
    muf,
    rate_monotonic,
)
from pbonet.analysis.schedule.servers import Server, ServerKind
from pbonet.analysis.schedule.transfers import (
    bandwidth,
    rate,
    read_wait,
    write_wait,
)


def demand(name: str, period: int, cost: int, deadline: int = 0) -> Demand:
    return Demand(name=name, period_ns=period, cost_ns=cost, deadline_ns=deadline)


FIGURE = [
    demand("t1", 6, 2),
    demand("t2", 10, 4),
    demand("t3", 12, 3),
    demand("t4", 15, 4),
]


def test_the_bounds_that_section_6_2_1_prints() -> None:
    printed = {1: 1.00, 2: 0.83, 3: 0.78}
    for count, bound in printed.items():
        assert round(liu_layland(count), 2) == bound
    assert round(math.log(2), 2) == 0.69
    assert liu_layland(10**6) == pytest.approx(math.log(2), abs=1e-6)


def test_figure_6_1_in_numbers() -> None:
    shares = [round(100 * utilization([task])) for task in FIGURE]
    assert shares == [33, 40, 25, 27]
    assert utilization(FIGURE) == pytest.approx(1.25)
    assert utilization(FIGURE[:3]) < 1.0
    assert critical_set(FIGURE) == ("t1", "t2", "t3")


def test_the_rules_of_criticality_agree() -> None:
    timings = [
        Timing(name=task.name, period=task.period_ns, maxc=task.cost_ns)
        for task in FIGURE
    ]
    for found, rule in (
        (critical_set(FIGURE), muf(timings)),
        (("t1", "t2"), rate_monotonic(timings, 0.01, 1.0)),
    ):
        assert set(found) == {name for name, given in rule.items() if given.in_set}


def test_response_times_of_figure_6_1() -> None:
    assert rm_response_times(FIGURE) == {"t1": 2, "t2": 6, "t3": None, "t4": None}
    assert response_time(FIGURE[1], FIGURE[:1]) == 6
    assert not rm_schedulable(FIGURE[:3])
    assert rm_schedulable(FIGURE[:2])


def test_beyond_the_bound_a_set_may_still_be_schedulable() -> None:
    """Harmonic periods are, up to all of the core."""
    harmonic = [demand("a", 2, 1), demand("b", 4, 1), demand("c", 8, 2)]
    assert utilization(harmonic) == 1.0
    assert not rm_bound_holds(harmonic)
    assert rm_response_times(harmonic) == {"a": 1, "b": 2, "c": 8}


def test_the_bound_is_met_exactly_by_the_worst_set() -> None:
    """Two tasks whose periods stand as 1 to sqrt(2) (Liu and Layland)."""
    unit = 10**9
    long = round(math.sqrt(2) * unit)
    worst = [demand("a", unit, long - unit), demand("b", long, 2 * unit - long)]
    assert utilization(worst) == pytest.approx(liu_layland(2), abs=1e-8)
    assert rm_schedulable(worst)
    assert not rm_schedulable([worst[0], demand("b", long, 2 * unit - long + 2)])


def test_equal_periods_may_go_either_way() -> None:
    pair = [demand("a", 10, 4), demand("b", 10, 5)]
    assert rm_response_times(pair) == {"a": 9, "b": 9}


def test_a_band_of_criticality_holds_what_edf_can_schedule() -> None:
    pair = [demand("a", 10, 5), demand("b", 14, 7)]
    assert edf_schedulable(pair)
    assert not rm_schedulable(pair)
    assert level_guaranteed(pair, {"a": 5, "b": 5}) == {"a", "b"}
    easier = [demand("a", 10, 5), demand("b", 14, 4)]
    levels = {"a": 5, "b": 5}
    assert level_response_times(easier, levels) == {"a": 9, "b": 9}
    three = [demand("a", 4, 2), demand("b", 8, 3)]
    assert level_response_times(three, levels) == {"a": None, "b": 7}
    assert level_guaranteed(three, levels) == {"a", "b"}
    assert level_guaranteed(three, {"a": 1, "b": 2}) == {"b"}


def test_edf_takes_the_whole_core() -> None:
    assert edf_schedulable(FIGURE[:3])
    assert not edf_schedulable(FIGURE)
    assert edf_schedulable([demand("a", 3, 1), demand("b", 7, 3), demand("c", 21, 5)])
    assert not edf_schedulable([
        demand("a", 3, 1),
        demand("b", 3, 1),
        demand("c", 3, 2),
    ])
    assert edf_schedulable([])


def test_edf_with_deadlines_before_the_period_ends() -> None:
    pair = [demand("a", 10, 3, 4), demand("b", 20, 4, 8)]
    assert edf_schedulable(pair)
    assert not edf_schedulable([demand("a", 10, 3, 4), demand("b", 20, 5, 7)])
    assert not edf_schedulable([demand("a", 10, 4, 4), demand("b", 20, 1, 4)])


def test_a_sporadic_server_counts_as_a_task() -> None:
    server = Server(kind=ServerKind.SPORADIC, capacity_ns=2, period_ns=10)
    tasks = [demand("a", 10, 5), demand("b", 20, 6)]
    assert edf_schedulable(tasks, [server])
    assert not edf_schedulable([*tasks, demand("c", 40, 1)], [server])
    assert (
        largest_server(
            Server(kind=ServerKind.SPORADIC, capacity_ns=0, period_ns=10_000),
            [demand("a", 20_000, 12_000)],
        )
        == 4_000
    )


def test_a_server_delays_rate_monotonic_tasks() -> None:
    task = demand("a", 20, 7)
    sporadic = Server(kind=ServerKind.SPORADIC, capacity_ns=3, period_ns=10)
    deferrable = Server(kind=ServerKind.DEFERRABLE, capacity_ns=3, period_ns=10)
    assert response_time(task, [], [sporadic]) == 10
    assert response_time(task, [], [deferrable]) == 13
    assert not rm_schedulable([demand("a", 12, 7)], [deferrable])
    assert rm_schedulable([demand("a", 12, 7)], [sporadic])


def test_servers_take_room_from_the_critical_set() -> None:
    server = Server(kind=ServerKind.DEFERRABLE, capacity_ns=2, period_ns=6)
    assert critical_set(FIGURE, [server]) == ("t1",)
    assert critical_set(FIGURE, limit=0.5) == ("t1",)
    assert critical_set(FIGURE, limit=0.3) == ()


def test_the_set_ends_at_the_first_task_that_does_not_fit() -> None:
    tasks = [demand("a", 10, 5), demand("b", 20, 12), demand("c", 40, 1)]
    assert critical_set(tasks) == ("a",)


def test_a_core_used_to_its_last_nanosecond() -> None:
    thirds = [demand(name, 3_000_000, 1_000_000) for name in "abc"]
    assert edf_schedulable(thirds)
    assert critical_set(thirds) == ("a", "b", "c")


def test_period_transformation_of_figure_6_1() -> None:
    (change,) = transform(FIGURE, {"t4"})
    assert (change.name, change.factor) == ("t4", 2)
    assert (change.period_ns, change.cost_ns) == (7, 2)
    assert transform(FIGURE, {"t1", "t3"}) == []
    assert transform(FIGURE, {"t1", "t2", "t3", "t4"}) is None


def test_period_transformation_goes_ahead_of_as_few_as_can_be() -> None:
    tasks = [demand("a", 10, 4), demand("b", 20, 10), demand("c", 70, 21)]
    (change,) = transform(tasks, {"c"})
    assert change.factor == 4
    assert change.period_ns == 17


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: demand("a", 0, 1), "a: period 0 ns is not above zero"),
        (lambda: demand("a", 1, -1), "a: execution time -1 ns is below zero"),
        (lambda: demand("a", 5, 1, 6), "a: deadline 6 ns is beyond the period"),
        (lambda: critical_set([], limit=0), "limit 0 is not within"),
        (lambda: rate([1], 0.0), "period 0.0 s is not above zero"),
        (lambda: read_wait(-1.0, 2), "2 retries of -1.0 are no time"),
    ],
)
def test_what_is_out_of_range_is_refused(call, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        call()


def test_traffic_by_equations_6_and_7() -> None:
    assert rate([48, 48, 48], 0.002) == pytest.approx(72_000)
    assert rate([48], 0.01, overhead=2) == pytest.approx(5_000)
    assert bandwidth([72_000, 5_000]) == 77_000


def test_waiting_for_the_lock_that_is_not_there() -> None:
    """What is left of equation 27."""
    assert write_wait() == 0
    assert read_wait(0.05, 15) == pytest.approx(0.75)
