"""Reading the log-linear histograms that tasks keep of their delays and CPU times.

16 bins of 1/16 microsecond below 1 microsecond, then 16 bins an octave: a quantile
read from one is off by 6 % at most. `rt_bin` in ``pbonet/node/rt/slot.h`` fills them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

BINS = 416
PER_OCTAVE = 16


def bin_of(ns: int) -> int:
    """Return the bin that counts a time of `ns` nanoseconds."""
    value = max(ns, 0) * PER_OCTAVE // 1000
    if value < PER_OCTAVE:
        return value
    octave = value.bit_length() - 5
    return min(PER_OCTAVE * octave + (value >> octave), BINS - 1)


def edge_ns(index: int) -> float:
    """Return the lower edge of a bin in nanoseconds; `BINS` gives the last one's upper.

    Raises:
        ValueError: There is no such bin.
    """
    if not 0 <= index <= BINS:
        msg = f"bin {index} is not within 0 to {BINS}"
        raise ValueError(msg)
    if index < PER_OCTAVE:
        return index * 1000 / PER_OCTAVE
    octave, part = divmod(index - PER_OCTAVE, PER_OCTAVE)
    return ((PER_OCTAVE + part) << octave) * 1000 / PER_OCTAVE


def octaves(counts: Sequence[int]) -> list[int]:
    """Return counts by powers of two: below 1 microsecond, then [2**(k-1), 2**k)."""
    return [sum(counts[low : low + PER_OCTAVE]) for low in range(0, BINS, PER_OCTAVE)]


def quantile_ns(counts: Sequence[int], share: float) -> float:
    """Return the time that `share` of the counts lie below, in nanoseconds.

    Counts within a bin are taken as evenly spread.

    Args:
        counts: One per bin.
        share: 0 to 1.

    Returns:
        Nanoseconds; 0 when nothing was counted.

    Raises:
        ValueError: `share` is out of its range.
    """
    if not 0 <= share <= 1:
        msg = f"share {share} is not within 0 to 1"
        raise ValueError(msg)
    total = sum(counts)
    if not total:
        return 0.0
    wanted, below = share * total, 0
    for index, count in enumerate(counts):
        if count and below + count >= wanted:
            low, high = edge_ns(index), edge_ns(index + 1)
            return low + (high - low) * (wanted - below) / count
        below += count
    return edge_ns(BINS)
