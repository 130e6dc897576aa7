"""The log-linear histogram: bins, edges, quantiles."""

import pytest

from pbonet.analysis.schedule.histogram import (
    BINS,
    bin_of,
    edge_ns,
    octaves,
    quantile_ns,
)


def counts(*times_ns):
    bins = [0] * BINS
    for ns in times_ns:
        bins[bin_of(ns)] += 1
    return bins


def test_every_bin_begins_where_the_last_one_ends() -> None:
    edges = [edge_ns(k) for k in range(BINS + 1)]
    assert edges == sorted(set(edges))
    assert edges[0] == 0
    assert edges[16] == 1000
    assert edges[BINS] == 1000 * 2**25


@pytest.mark.parametrize("ns", [0, 1, 62, 63, 999, 1000, 1062, 1063, 12345, 10**9])
def test_a_time_lies_in_its_bin(ns) -> None:
    k = bin_of(ns)
    assert edge_ns(k) <= ns + 1
    assert ns < edge_ns(k + 1)


def test_beyond_the_last_bin_and_below_zero() -> None:
    assert bin_of(10**12) == BINS - 1
    assert bin_of(-5) == 0


def test_octaves_are_powers_of_two_microseconds() -> None:
    got = octaves(counts(500, 1000, 1999, 2000, 4000, 7999))
    assert got[:5] == [1, 2, 1, 2, 0]
    assert sum(got) == 6


def test_quantiles_are_right_within_a_bin() -> None:
    bins = counts(*range(0, 1_000_000, 100))
    for share in (0.1, 0.5, 0.9, 0.99):
        assert quantile_ns(bins, share) == pytest.approx(share * 1e6, rel=1 / 16)


def test_nothing_counted() -> None:
    assert quantile_ns([0] * BINS, 0.5) == 0


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="share 2 is not within 0 to 1"):
        quantile_ns([1] * BINS, 2)
    with pytest.raises(ValueError, match="bin 417 is not within 0 to 416"):
        edge_ns(417)
