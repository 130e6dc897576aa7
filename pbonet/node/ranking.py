"""Which criticality and priority each task of an RTPU has (Stewart 1994, 6.2.3, 4.5.1).

The scheduler's rule fills in what neither the RMOD nor the master says; all tasks of
the RTPU count, of whichever subsystem, because they share its core.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.sched.criticality import Assigned, Timing, edf, muf, rate_monotonic

if TYPE_CHECKING:
    from collections.abc import Iterable

LIMIT = 0.95
"""Share of the core that the critical set may use: above it the kernel throttles."""
SLOWEST = 1e6
"""Seconds; stands for the period of a task that has none."""


class Wish(Struct, kw_only=True):
    """What is known of one task before it is ranked."""

    name: str
    freq: float
    """Hz; 0 where the task is not periodic."""
    maxc: float | None = None
    rmod_crit: int | None = None
    told: tuple[int | None, int] | None = None
    """Criticality (None: the rule's) and priority that the master gave."""
    spawn_crit: int | None = None
    priority: int = 0


class Ranked(Struct, frozen=True):
    """What a task is ranked by."""

    crit: int
    priority: int
    assumed: bool


def rank(
    scheduler: str, wishes: Iterable[Wish], *, minfreq: float, maxfreq: float
) -> dict[str, Ranked]:
    """Return what every task is ranked by.

    Args:
        scheduler: ``MUF``, ``EDF`` or ``RM``.
        wishes: Every task of the RTPU.
        minfreq: Hz; lowest rate that RM tells apart.
        maxfreq: Hz; highest rate that RM tells apart.
    """
    wishes = list(wishes)
    timings = [
        Timing(
            name=wish.name,
            period=1.0 / wish.freq if wish.freq > 0 else SLOWEST,
            maxc=wish.maxc,
            crit=_fixed(wish),
        )
        for wish in wishes
    ]
    assigned = _rule(scheduler, timings, minfreq, maxfreq)
    return {wish.name: _ranked(wish, assigned[wish.name]) for wish in wishes}


def _rule(
    scheduler: str, timings: list[Timing], minfreq: float, maxfreq: float
) -> dict[str, Assigned]:
    if scheduler == "EDF":
        return edf(timings)
    if scheduler == "RM":
        return rate_monotonic(timings, minfreq, maxfreq)
    return muf(timings, LIMIT)


def _fixed(wish: Wish) -> int | None:
    """Return the criticality that somebody fixed: the master before the RMOD."""
    told = wish.told[0] if wish.told is not None else wish.spawn_crit
    return wish.rmod_crit if told is None else told


def _ranked(wish: Wish, assigned: Assigned) -> Ranked:
    priority = wish.priority if wish.told is None else wish.told[1]
    return Ranked(assigned.crit, priority, assigned.assumed)
