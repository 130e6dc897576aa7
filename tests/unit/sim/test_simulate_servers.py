"""Aperiodic servers on the virtual core, worked by hand (section 6.5)."""

from functools import partial
from itertools import pairwise
from random import Random

import pytest

from pbonet.analysis.schedule.servers import ServerKind
from pbonet.analysis.schedule.simulate import (
    PeriodicTask,
    ServerTask,
    poisson,
    simulate,
)

HOG = PeriodicTask(name="hog", period_ns=100, cost=60)


def server(kind: str, *arrivals: tuple[int, int], **more) -> ServerTask:
    given = {"capacity_ns": 3, "period_ns": 10, **more}
    return ServerTask(name="s", kind=ServerKind(kind), arrivals=arrivals, **given)


def pieces(outcome, name: str = "s") -> list[tuple[int, int, int]]:
    return [(s.start_ns, s.end_ns, s.crit) for s in outcome.segments if s.task == name]


def test_a_deferrable_server_keeps_its_capacity_and_serves_at_once() -> None:
    outcome = simulate([HOG], [server("deferrable", (14, 2), (18, 1))], until_ns=100)
    assert pieces(outcome) == [(14, 16, 6), (18, 19, 6)]
    assert outcome.responses("s").max_ns == 2
    assert outcome.tasks["s"].overruns == 0


def test_a_deferrable_server_used_up_waits_behind_the_critical_set() -> None:
    outcome = simulate([HOG], [server("deferrable", (12, 5))], until_ns=100)
    assert pieces(outcome) == [(12, 15, 6), (20, 22, 6)]
    assert outcome.tasks["s"].overruns == 1


def test_leftover_time_is_used_at_criticality_4() -> None:
    idle = PeriodicTask(name="a", period_ns=100, cost=2)
    outer = PeriodicTask(name="outer", period_ns=100, cost=50, crit=3)
    outcome = simulate([idle, outer], [server("deferrable", (0, 8))], until_ns=100)
    assert pieces(outcome) == [(0, 3, 6), (5, 10, 4)]


def test_a_deferrable_server_strikes_twice_in_a_row() -> None:
    outcome = simulate([HOG], [server("deferrable", (7, 6))], until_ns=100)
    assert pieces(outcome) == [(7, 13, 6)]


def test_a_sporadic_server_gets_each_piece_back_one_period_after_its_begin() -> None:
    arrivals = [(7, 2), (12, 4)]
    outcome = simulate([HOG], [server("sporadic", *arrivals)], until_ns=100)
    assert pieces(outcome) == [(7, 9, 6), (12, 13, 6), (17, 19, 6), (22, 23, 6)]


def test_time_at_criticality_4_is_not_given_back() -> None:
    """Listing 4 would return it, and so let the server have more than its capacity."""
    short = PeriodicTask(name="a", period_ns=100, cost=2)
    busy = PeriodicTask(name="b", period_ns=100, cost=60, offset_ns=9)
    arrivals = [(0, 8), (10, 8)]
    outcome = simulate([short, busy], [server("sporadic", *arrivals)], until_ns=40)
    assert pieces(outcome)[:4] == [(0, 3, 6), (5, 9, 4), (10, 13, 6), (20, 23, 6)]


def test_a_polling_server_loses_what_nobody_wants() -> None:
    outcome = simulate([HOG], [server("polling", (1, 2), (21, 5))], until_ns=100)
    assert pieces(outcome) == [(10, 12, 6), (30, 33, 6), (40, 42, 6)]


def test_work_without_end_takes_what_is_left_and_nothing_more() -> None:
    endless = ServerTask(
        name="s", kind=ServerKind.BACKGROUND, arrivals=(), more=lambda: 15
    )
    outcome = simulate([HOG], [endless], until_ns=200)
    assert pieces(outcome) == [(60, 100, 1), (160, 200, 1)]
    assert outcome.tasks["s"].cycles == 5
    assert outcome.tasks["s"].releases == 6
    assert outcome.missing == set()


def test_background_service_waits_for_everybody() -> None:
    late = ServerTask(name="s", kind=ServerKind.BACKGROUND, arrivals=[(5, 4)])
    outcome = simulate([HOG], [late], until_ns=100)
    assert pieces(outcome) == [(60, 64, 1)]


def test_a_server_of_rm_waits_for_its_replenishment() -> None:
    outcome = simulate(
        [], [server("deferrable", (2, 8), crit=62, drop_crit=None)], until_ns=100
    )
    assert pieces(outcome) == [(2, 5, 62), (10, 13, 62), (20, 22, 62)]
    outcome = simulate(
        [], [server("sporadic", (2, 8), crit=62, drop_crit=None)], until_ns=100
    )
    assert pieces(outcome) == [(2, 5, 62), (12, 15, 62), (22, 24, 62)]


def test_events_are_served_in_the_order_in_which_they_come() -> None:
    outcome = simulate([], [server("deferrable", (1, 1), (1, 1), (2, 1))], until_ns=9)
    assert outcome.tasks["s"].responses_ns == [1, 2, 2]
    assert outcome.tasks["s"].releases == outcome.tasks["s"].cycles == 3


def test_a_server_misses_no_deadline_but_its_events_wait() -> None:
    outcome = simulate([HOG], [server("deferrable", (0, 90))], until_ns=100)
    assert outcome.missing == set()
    row = outcome.as_text().splitlines()[-1].split()
    assert row[:6] == ["s", "6", "1", "0", "-", "-"]


def test_poisson_events_come_at_their_rate_and_from_the_seed() -> None:
    def events(seed: int) -> list[tuple[int, int]]:
        source = partial(Random(seed).expovariate, 1.0)
        return list(poisson(source, 50.0, lambda: 7, 100 * 10**9))

    got = events(3)
    assert got == events(3)
    assert got != events(4)
    assert len(got) == pytest.approx(5000, rel=0.05)
    assert all(a[0] <= b[0] for a, b in pairwise(got))
    assert {cost for _, cost in got} == {7}


def test_a_capacity_beyond_the_period_is_refused() -> None:
    with pytest.raises(ValueError, match="s: the capacity is above zero, at most"):
        simulate([], [server("sporadic", capacity_ns=11)], until_ns=10)
