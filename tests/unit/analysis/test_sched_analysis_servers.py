"""Server sizes and bounds against the figures and sentences of section 6.5."""

import math

import pytest

from pbonet.analysis.schedule.analysis import Demand, edf_schedulable, largest_server
from pbonet.analysis.schedule.servers import (
    Server,
    ServerKind,
    bound_for_size,
    periodic_bound,
    safe_bound,
    safe_size,
    schedulable_bound,
    server_size,
)

DS, SS = ServerKind.DEFERRABLE, ServerKind.SPORADIC
RM, MUF = math.inf, 1
LOADS = [k / 100 for k in range(101)]


@pytest.mark.parametrize("up", [k / 20 for k in range(21)])
def test_the_equations_as_they_are_printed(up: float) -> None:
    e = math.exp(-up)
    assert server_size(DS, up) == pytest.approx(max(0, (2 * e - 1) / (2 - e)))  # 12
    assert server_size(SS, up) == pytest.approx(max(0, 2 * e - 1))  # 15
    assert server_size(DS, up, tasks=MUF) == pytest.approx((1 - up) / (2 * up + 1))
    assert server_size(SS, up, tasks=MUF) == pytest.approx(2 / (up + 1) - 1)


@pytest.mark.parametrize("us", [k / 20 for k in range(21)])
def test_the_other_way_round(us: float) -> None:
    assert periodic_bound(DS, us) == pytest.approx(math.log((us + 2) / (2 * us + 1)))
    assert periodic_bound(SS, us) == pytest.approx(math.log(2 / (us + 1)))
    muf = (us + 2) / (2 * us + 1) - 1
    assert periodic_bound(DS, us, tasks=MUF) == pytest.approx(muf)
    assert bound_for_size(DS, us, tasks=MUF) == pytest.approx(muf + us)  # 23
    mss = 2 / (us + 1) - 1
    assert periodic_bound(SS, us, tasks=MUF) == pytest.approx(mss)
    assert bound_for_size(SS, us, tasks=MUF) == pytest.approx(mss + us)  # 26
    m = 4
    ten = (m - 1) * (((us + 2) / (2 * us + 1)) ** (1 / (m - 1)) - 1)
    assert periodic_bound(DS, us, tasks=m - 1) == pytest.approx(ten)
    thirteen = (m - 1) * ((2 / (us + 1)) ** (1 / (m - 1)) - 1)
    assert periodic_bound(SS, us, tasks=m - 1) == pytest.approx(thirteen)


def test_without_a_server_rm_has_its_own_bound_and_muf_all() -> None:
    for kind in (DS, SS):
        assert periodic_bound(kind, 0.0) == pytest.approx(math.log(2))
        assert periodic_bound(kind, 0.0, tasks=3) == pytest.approx(
            3 * (2 ** (1 / 3) - 1)
        )
        assert periodic_bound(kind, 0.0, tasks=MUF) == pytest.approx(1.0)
        assert server_size(kind, 0.0, tasks=MUF) == server_size(kind, 0.0) == 1.0


def test_figure_6_7_the_mss_is_the_largest_in_all_cases() -> None:
    for up in LOADS[1:]:
        mss = server_size(SS, up, tasks=MUF)
        others = [
            server_size(DS, up, tasks=MUF),
            server_size(SS, up),
            server_size(DS, up),
        ]
        assert all(mss >= other for other in others)
        assert server_size(DS, up, tasks=MUF) >= server_size(DS, up)


def test_figure_6_8_the_mds_is_better_than_the_rss_above_42_percent() -> None:
    def w(kind: ServerKind, up: float, tasks: float) -> float:
        return schedulable_bound(kind, up, tasks=tasks)

    for up in LOADS:
        assert (
            w(SS, up, MUF) >= max(w(DS, up, MUF), w(SS, up, RM), w(DS, up, RM)) - 1e-12
        )
        assert w(DS, up, MUF) >= w(DS, up, RM) - 1e-12
    better = [up for up in LOADS[1:] if w(DS, up, MUF) > w(SS, up, RM)]
    assert min(better) == pytest.approx(0.42)
    assert better == [up for up in LOADS if up >= 0.42]


def test_figure_6_8_beyond_its_bound_rm_has_nothing_more_to_give() -> None:
    assert schedulable_bound(DS, 0.9) == pytest.approx(math.log(2))
    assert schedulable_bound(SS, 0.9, tasks=MUF) == pytest.approx(0.9 + 2 / 1.9 - 1)


def test_figure_6_9_the_mss_has_the_highest_bound_for_every_size() -> None:
    for size in LOADS:
        mss = bound_for_size(SS, size, tasks=MUF)
        assert mss >= bound_for_size(DS, size, tasks=MUF) - 1e-12
        assert mss >= bound_for_size(SS, size) - 1e-12
        assert mss >= bound_for_size(DS, size) - 1e-12


def test_polling_and_background_have_no_equation() -> None:
    with pytest.raises(ValueError, match="a polling server has no equation"):
        server_size(ServerKind.POLLING, 0.5)
    with pytest.raises(ValueError, match="a background server has no equation"):
        periodic_bound(ServerKind.BACKGROUND, 0.5)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: server_size(DS, 1.1), "utilization 1.1 is not within"),
        (lambda: server_size(DS, 0.5, tasks=0), "0 periodic tasks have no bound"),
        (lambda: periodic_bound(DS, -0.1), "server size -0.1 is not within"),
        (lambda: periodic_bound(DS, 0.1, tasks=0.5), "0.5 periodic tasks"),
        (
            lambda: Server(name="s", kind=DS, capacity_ns=11, period_ns=10),
            "server s: capacity 11 ns is not within 0 and the period, 10 ns",
        ),
    ],
)
def test_what_is_out_of_range_is_refused(call, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        call()


def test_a_deferrable_server_may_strike_twice_in_a_row() -> None:
    server = Server(kind=DS, capacity_ns=3, period_ns=10)
    taken = [server.taken_ns(window) for window in (0, 2, 6, 13, 14, 16, 17, 23, 26)]
    assert taken == [0, 2, 6, 6, 7, 9, 9, 9, 12]
    steady = Server(kind=SS, capacity_ns=3, period_ns=10)
    taken = [steady.taken_ns(window) for window in (0, 2, 6, 10, 11, 13, 20, 23)]
    assert taken == [0, 2, 3, 3, 4, 6, 6, 9]


def test_equation_22_promises_too_much_below_one_half() -> None:
    """Decision 0090: a server of 40 %, and a task with just a longer period.

    Equation 21 allows U_p = 0.6 / 1.8 = 33.3 %. In a period of the task the server may
    run twice, 8 of its 10.001 ms, so there is room for 20 % only.
    """
    server = Server(kind=DS, capacity_ns=4_000_000, period_ns=10_000_000)
    assert periodic_bound(DS, 0.4, tasks=MUF) == pytest.approx(1 / 3)
    assert safe_bound(DS, 0.4) == pytest.approx(0.2)

    def task(cost_ns: int) -> list[Demand]:
        return [Demand(name="a", period_ns=10_001_000, cost_ns=cost_ns)]

    assert not edf_schedulable(task(3_000_000), [server])
    assert edf_schedulable(task(2_000_000), [server])


def test_the_safe_size_is_the_equation_where_that_is_safe() -> None:
    for up in LOADS:
        assert safe_size(SS, up) == server_size(SS, up, tasks=MUF)
        if up >= 0.5:
            assert safe_size(DS, up) == pytest.approx(server_size(DS, up, tasks=MUF))
        else:
            assert safe_size(DS, up) == (1 - up) / 2 < server_size(DS, up, tasks=MUF)
        for kind in (DS, SS):
            if safe_size(kind, up) > 0:
                assert safe_bound(kind, safe_size(kind, up)) == pytest.approx(up)


@pytest.mark.parametrize("kind", [DS, SS])
@pytest.mark.parametrize("up", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_no_periods_allow_less_than_the_safe_size(kind: ServerKind, up: float) -> None:
    """And some periods allow no more: the bound is tight."""
    period = 10_000_000
    found = []
    for task_period in range(10_000_000, 30_000_001, 250_000):
        task = Demand(name="a", period_ns=task_period, cost_ns=int(up * task_period))
        server = Server(kind=kind, capacity_ns=0, period_ns=period)
        found.append(largest_server(server, [task]) / period)
    assert min(found) >= safe_size(kind, up) - 1e-3
    assert min(found) <= safe_size(kind, up) + 0.03
