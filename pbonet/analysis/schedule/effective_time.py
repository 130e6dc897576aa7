"""Soft real-time tasks: how much to reserve for a task that may miss some deadlines.

The execution profile Psi(t) of a task is the share of its cycles that need at most the
CPU time t (section 6.4 of Stewart 1994). A task of softness S is analysed with the
effective execution time E, for which Psi(E) = 1 - S, in place of the worst one, C. In
each period it has E at its own criticality; what a cycle needs beyond that it gets from
what the others leave, and from E of the periods that follow.
"""

from __future__ import annotations

import math
from enum import StrEnum
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

from msgspec import Struct

from .histogram import BINS, edge_ns

if TYPE_CHECKING:
    import random
    from collections.abc import Iterable, Sequence


class Basis(StrEnum):
    """The source of an effective execution time."""

    GIVEN = "given"
    MEASURED = "measured"
    ASSUMED = "assumed"
    """Nothing is known but the worst time, whose value is it."""


class Effective(Struct, frozen=True):
    """E of a soft task and what it rests on."""

    time_ns: int | None
    """None while not even the worst time is known."""
    basis: Basis


class Profile(Struct, frozen=True):
    """An execution profile: a step function that rises to 1.

    Made by `from_samples`, `from_histogram` or `from_steps`.
    """

    times_ns: tuple[int, ...]
    """Where it steps, rising; the last one is the worst execution time."""
    shares: tuple[float, ...]
    """Its value from there on; the last one is 1."""

    def psi(self, time_ns: float) -> float:
        """Return the probability that a cycle needs at most `time_ns` of CPU time."""
        found = 0.0
        for time, share in zip(self.times_ns, self.shares, strict=True):
            if time > time_ns:
                break
            found = share
        return found

    @property
    def worst_ns(self) -> int:
        """C: the smallest t with Psi(t) = 1."""
        return self.times_ns[-1]

    def effective_ns(self, softness: float) -> int:
        """Return E: the smallest t with Psi(t) >= 1 - softness.

        The thesis asks for Psi(t) = 1 - S; a measured profile rises in steps and need
        not take that value, then the next step counts.

        Args:
            softness: Share of the cycles that may miss; 0 gives C.

        Returns:
            CPU nanoseconds.

        Raises:
            ValueError: `softness` is out of its range.
        """
        if not 0 <= softness < 1:
            msg = f"softness {softness} is not within [0, 1)"
            raise ValueError(msg)
        hardness = (1.0 - softness) * (1 - 1e-12)
        for time, share in zip(self.times_ns, self.shares, strict=True):
            if share >= hardness:
                return time
        return self.worst_ns

    def periods(self, effective_ns: int) -> float:
        """Return how many periods a cycle takes on average, with E in each at worst.

        Nothing left over by others is counted on.

        Raises:
            ValueError: `effective_ns` is not above zero.
        """
        total = before = 0.0
        for time, share in zip(self.times_ns, self.shares, strict=True):
            total += (share - before) * every(time, effective_ns)
            before = share
        return total

    def on_time_share(self, effective_ns: int) -> float:
        """Return the share of all periods in which a cycle begins and ends, at worst.

        A cycle that overruns E loses its own period and those it continues into; so
        this is below Psi(E), which counts cycles (`docs/decisions/0092`).

        Args:
            effective_ns: E, CPU nanoseconds, above zero.

        Raises:
            ValueError: It is not.
        """
        return self.psi(effective_ns) / self.periods(effective_ns)

    def draw_ns(self, source: random.Random) -> int:
        """Return a random execution time with this profile."""
        at = source.random()
        for time, share in zip(self.times_ns, self.shares, strict=True):
            if at < share:
                return time
        return self.worst_ns


def from_steps(steps: Iterable[tuple[int, float]]) -> Profile:
    """Return the profile of pairs of time and share.

    Args:
        steps: CPU nanoseconds, above zero and rising, and Psi from there on, rising
            to 1.

    Raises:
        ValueError: They are not so.
    """
    pairs = list(steps)
    times = tuple(time for time, _ in pairs)
    shares = tuple(share for _, share in pairs)
    rising = all(a < b for a, b in pairwise(times))
    steady = all(a <= b for a, b in pairwise(shares))
    if not pairs or not rising or not steady or times[0] <= 0 or shares[0] < 0:
        msg = f"an execution profile rises in time and share, this does not: {pairs}"
        raise ValueError(msg)
    if not math.isclose(shares[-1], 1.0):
        msg = f"an execution profile ends at 1, this one at {shares[-1]}"
        raise ValueError(msg)
    return Profile(times, (*shares[:-1], 1.0))


def from_samples(times_ns: Iterable[int]) -> Profile:
    """Return the profile of measured execution times, nanoseconds above zero.

    Raises:
        ValueError: There are none, or one is not above zero.
    """
    ordered = sorted(times_ns)
    counts: dict[int, int] = {}
    for time in ordered:
        counts[time] = counts.get(time, 0) + 1
    return from_steps(
        (time, below / len(ordered))
        for time, below in zip(counts, accumulate(counts.values()), strict=True)
    )


def from_histogram(counts: Sequence[int], *, worst_ns: int = 0) -> Profile:
    """Return the profile of a task's histogram of CPU times.

    Every count stands at the upper edge of its bin, so that a reserve read from the
    profile is at most 6.25 % too large and never too small.

    Args:
        counts: One per bin of `pbonet.analysis.schedule.histogram`.
        worst_ns: The greatest time measured, if known: no step is beyond it.

    Raises:
        ValueError: Nothing was counted, or there are not `BINS` counts.
    """
    if len(counts) != BINS or not any(counts):
        msg = f"a profile needs {BINS} counts, not all 0"
        raise ValueError(msg)
    total, below = sum(counts), 0
    steps: dict[int, float] = {}
    for index, count in enumerate(counts):
        below += count
        if count:
            edge = math.ceil(edge_ns(index + 1))
            steps[min(edge, worst_ns) if worst_ns > 0 else edge] = below / total
    return from_steps(steps.items())


def effective(
    softness: float,
    *,
    given_ns: int | None = None,
    profile: Profile | None = None,
    worst_ns: int | None = None,
) -> Effective:
    """Return what to reserve for a soft task in each period: E of section 6.4.

    A declared value comes first, then what the profile says for this softness,
    but never more than the worst time; without both the worst time stands for E,
    which reserves more than is needed.

    Args:
        softness: Share of the cycles that may miss.
        given_ns: E as declared.
        profile: As measured.
        worst_ns: C, declared or measured.

    Raises:
        ValueError: `softness` is not within [0, 1).
    """
    if given_ns is not None:
        return Effective(given_ns, Basis.GIVEN)
    if profile is None:
        return Effective(worst_ns, Basis.ASSUMED)
    found = profile.effective_ns(softness)
    return Effective(
        found if worst_ns is None else min(found, worst_ns), Basis.MEASURED
    )


def every(worst_ns: int, effective_ns: int) -> int:
    """Return n so that at least one of every n cycles is executed: C <= n * E.

    Args:
        worst_ns: C, CPU nanoseconds.
        effective_ns: E, CPU nanoseconds, above zero.

    Raises:
        ValueError: E is not above zero.
    """
    if effective_ns <= 0:
        msg = f"effective execution time {effective_ns} ns is not above zero"
        raise ValueError(msg)
    return max(1, -(-worst_ns // effective_ns))
