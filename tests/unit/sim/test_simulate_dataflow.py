"""The error due to data flow (section 6.2.4, Figures 6.4 and 6.5)."""

import math

import numpy as np
import pytest

from pbonet.analysis.schedule.dataflow import ALPHA, MS, Chain, K, errors, run


def test_figure_6_4_the_output_is_one_period_later_when_b_goes_first() -> None:
    first = run(Chain(a_first=True), 5.0)
    second = run(Chain(a_first=False), 5.0)
    assert first.error < second.error
    steps = [np.flatnonzero(np.diff(one.output)) for one in (first, second)]
    assert len(steps[0]) == len(steps[1]) == 100
    assert set(np.round(np.diff(first.time_s[steps[0]]), 3)) == {0.05}


def test_the_error_is_that_of_the_mean_delay() -> None:
    """Sampled, held for a period: from 10 to 60 ms old, or from 50 to 100 ms."""

    def mean_error(low: float, high: float) -> float:
        ages = np.linspace(low, high, 501)
        return float(np.mean(2 * K * np.abs(np.sin(ALPHA * ages / 2)) * 2 / math.pi))

    assert run(Chain(a_first=True), 20 * math.pi / 5).error == pytest.approx(
        mean_error(0.010, 0.060), rel=0.02
    )
    assert run(Chain(a_first=False), 20 * math.pi / 5).error == pytest.approx(
        mean_error(0.050, 0.100), rel=0.02
    )


def test_figure_6_5_the_flow_of_data_counts_at_every_period() -> None:
    periods = [k * MS for k in (20, 25, 33, 50, 70, 100, 130, 150, 200)]
    best = errors(periods, a_first=True, seconds=8.0)
    worst = errors(periods, a_first=False, seconds=8.0)
    assert (best <= worst + 0.05).all()
    gain = dict(zip((p // MS for p in periods), worst - best, strict=True))
    assert min(gain[k] for k in (50, 100)) > max(gain[k] for k in (33, 70, 130))


def test_twice_the_frequency_does_what_the_right_order_does() -> None:
    """The observation that closes section 6.2.4, for T = 200 and T / 2 = 100 ms."""
    (best,) = errors([200 * MS], a_first=True)
    (worst,) = errors([100 * MS], a_first=False)
    assert best == pytest.approx(worst, rel=0.05)


def test_a_user_priority_decides_only_between_equal_deadlines() -> None:
    """Decision 0091: so it shows at T_b = T_a, and not at other periods."""

    def gain(period_b: int) -> float:
        chains = [
            Chain(period_b_ns=period_b * MS, a_first=first, fixed=False)
            for first in (True, False)
        ]
        best, worst = (run(chain, 5.0).error for chain in chains)
        return worst - best

    assert gain(50) > 10
    assert gain(100) == 0


def test_a_chain_that_cannot_be_scheduled_says_nothing() -> None:
    with pytest.raises(ValueError, match="not schedulable: b missed deadlines"):
        run(Chain(period_b_ns=10 * MS, cost_b_ns=10 * MS), 1.0)
