"""Execution profiles, effective execution times and what they promise (section 6.4)."""

import random

import pytest

from pbonet.analysis.schedule.effective_time import (
    every,
    from_histogram,
    from_samples,
    from_steps,
)
from pbonet.analysis.schedule.histogram import BINS, bin_of

MS = 1_000_000
FIGURE_6_6 = from_steps([
    (2 * MS, 0.1), (3 * MS, 0.35), (4 * MS, 0.65), (5 * MS, 0.8), (6 * MS, 0.9),
    (7 * MS, 0.94), (8 * MS, 0.97), (9 * MS, 0.99), (10 * MS, 1.0),
])  # fmt: skip
"""With the values that the text reads from the figure: 90 % within 6, all within 10."""


def test_the_example_of_section_6_4() -> None:
    period = 12 * MS
    assert FIGURE_6_6.worst_ns == 10 * MS
    assert round(100 * FIGURE_6_6.worst_ns / period) == 83
    effective = FIGURE_6_6.effective_ns(0.1)
    assert effective == 6 * MS
    assert effective / period == 0.5
    assert FIGURE_6_6.effective_ns(0.0) == FIGURE_6_6.worst_ns
    assert every(FIGURE_6_6.worst_ns, effective) == 2


def test_psi_is_a_distribution() -> None:
    assert FIGURE_6_6.psi(0) == 0.0
    assert FIGURE_6_6.psi(2 * MS - 1) == 0.0
    assert FIGURE_6_6.psi(6.5 * MS) == 0.9
    assert FIGURE_6_6.psi(99 * MS) == 1.0


def test_a_hardness_between_two_steps_takes_the_next_one() -> None:
    """The thesis's Psi(t) = H has no solution there."""
    assert FIGURE_6_6.effective_ns(0.15) == 6 * MS
    assert FIGURE_6_6.effective_ns(0.2) == 5 * MS
    assert FIGURE_6_6.effective_ns(0.999) == 2 * MS


def test_counted_in_periods_fewer_are_kept() -> None:
    """Decision 0092: nine of ten cycles in time are nine of eleven periods."""
    assert FIGURE_6_6.periods(6 * MS) == pytest.approx(1.1)
    assert FIGURE_6_6.on_time_share(6 * MS) == pytest.approx(0.9 / 1.1)
    assert FIGURE_6_6.on_time_share(8 * MS) >= 0.9 > FIGURE_6_6.on_time_share(7 * MS)


@pytest.mark.parametrize(
    ("worst", "effective", "n"), [(10, 6, 2), (12, 6, 2), (13, 6, 3), (1, 6, 1)]
)
def test_at_least_one_of_every_n_cycles(worst: int, effective: int, n: int) -> None:
    assert every(worst, effective) == n
    assert worst <= n * effective


def test_a_profile_of_samples() -> None:
    profile = from_samples([5, 1, 1, 3])
    assert profile.times_ns == (1, 3, 5)
    assert profile.shares == (0.5, 0.75, 1.0)


def test_a_profile_of_a_tasks_histogram_is_never_too_small() -> None:
    source = random.Random(1)
    times = [round(source.lognormvariate(11, 0.6)) for _ in range(5000)]
    counts = [0] * BINS
    for time in times:
        counts[bin_of(time)] += 1
    profile = from_histogram(counts, worst_ns=max(times))
    exact = from_samples(times)
    assert profile.worst_ns == max(times)
    for softness in (0.0, 0.01, 0.1, 0.5):
        wanted = exact.effective_ns(softness)
        assert wanted <= profile.effective_ns(softness) <= 1.0626 * wanted
    assert from_histogram(counts).worst_ns >= max(times)


def test_drawing_gives_the_profile_back() -> None:
    source = random.Random(7)
    drawn = from_samples(FIGURE_6_6.draw_ns(source) for _ in range(20_000))
    for time in FIGURE_6_6.times_ns:
        assert drawn.psi(time) == pytest.approx(FIGURE_6_6.psi(time), abs=0.015)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: from_steps([]), "rises in time and share"),
        (lambda: from_steps([(2, 0.5), (2, 1.0)]), "rises in time and share"),
        (lambda: from_steps([(1, 0.5), (2, 0.4), (3, 1.0)]), "rises in time and share"),
        (lambda: from_steps([(0, 1.0)]), "rises in time and share"),
        (lambda: from_steps([(1, 0.5)]), "ends at 1, this one at 0.5"),
        (lambda: from_samples([]), "rises in time and share"),
        (lambda: from_histogram([0] * BINS), "not all 0"),
        (lambda: from_histogram([1]), f"needs {BINS} counts"),
        (lambda: FIGURE_6_6.effective_ns(1.0), "softness 1.0 is not within"),
        (lambda: every(1, 0), "0 ns is not above zero"),
    ],
)
def test_what_is_out_of_range_is_refused(call, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        call()
