"""Criticalities: MUF, EDF and RM as three ways to fill one number.

The dispatcher ranks by criticality, then deadline, then user priority (Stewart 1994,
section 6.2.3). Which algorithm that amounts to depends on the criticalities alone:
two values split at the critical set give MUF, one value for all gives EDF, and a value
per rate gives RM. So the algorithm of an RTPU is chosen here and nowhere else.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterable

LOWEST = 0
"""Reserved for work that only uses what is left over."""
OUTSIDE = 3
"""Periodic tasks outside the critical set (section 6.2.3)."""
INSIDE = 5
"""The critical set."""
EXHAUSTED = 4
"""A server that has used its capacity up (section 6.5.2.1)."""
RM_LEVELS = 62
"""Criticalities 1 to 62; 0 and 63 are reserved (section 4.5.1)."""


def dropped(crit: int, *, fixed_rates: bool, server: bool = False) -> int:
    """Return the criticality of a task that has used up its reserve.

    Section 6.4.1 lowers a soft task to 3, section 6.5.2.1 a server to 4; under RM,
    whose criticalities are rates, what is left over is below all of them.

    Args:
        crit: That of the task.
        fixed_rates: The RTPU schedules by RM.
        server: The task is an aperiodic server.
    """
    if fixed_rates:
        return LOWEST
    return min(crit, EXHAUSTED if server else OUTSIDE)


class Timing(Struct, frozen=True, kw_only=True):
    """A task as the rules need it."""

    name: str
    period: float
    """Seconds, above 0."""
    maxc: float | None = None
    """Worst-case CPU seconds a cycle; None while unknown."""
    crit: int | None = None
    """Criticality that the RMOD fixes; the rules leave it as it is."""


class Assigned(Struct, frozen=True, kw_only=True):
    """The criticality of a task and what it rests on."""

    crit: int
    assumed: bool
    """It rests on an execution time that is not known yet."""
    in_set: bool
    """The task belongs to the critical set."""
    utilization: float
    """Of the tasks counted so far, this one included, as far as known."""


def by_period(tasks: Iterable[Timing]) -> list[Timing]:
    """Return the tasks from shortest to longest period, names breaking ties.

    Raises:
        ValueError: A period is not above zero, or an execution time is below zero.
    """
    ordered = sorted(tasks, key=lambda task: (task.period, task.name))
    for task in ordered:
        if not task.period > 0 or not math.isfinite(task.period):
            msg = f"{task.name}: period {task.period} s is not above zero"
            raise ValueError(msg)
        if task.maxc is not None and not task.maxc >= 0:
            msg = f"{task.name}: MAXC {task.maxc} s is below zero"
            raise ValueError(msg)
    return ordered


def muf(tasks: Iterable[Timing], limit: float = 1.0) -> dict[str, Assigned]:
    """Split the tasks into the critical set and the rest (section 6.2.3).

    The set is the first N tasks, from the shortest period on, whose utilization stays
    within `limit`; the first that does not fit ends it, even if a later one would fit.
    A task with unknown execution time counts as nothing, and it and all after it are
    marked as assumed. A criticality fixed by the RMOD is kept; the task's load counts.

    Args:
        tasks: All tasks of one RTPU.
        limit: The share of the core that the set may use, above 0, at most 1.

    Returns:
        By name: INSIDE or OUTSIDE, and what that rests on.

    Raises:
        ValueError: A period, an execution time or `limit` is out of its range.
    """
    if not 0 < limit <= 1:
        msg = f"limit {limit} is not within (0, 1]"
        raise ValueError(msg)
    result: dict[str, Assigned] = {}
    used, assumed, fits = 0.0, False, True
    for task in by_period(tasks):
        assumed = assumed or task.maxc is None
        used += (task.maxc or 0.0) / task.period
        fits = fits and used <= limit * (1 + 1e-12)
        rule = INSIDE if fits else OUTSIDE
        result[task.name] = Assigned(
            crit=rule if task.crit is None else task.crit,
            assumed=assumed and task.crit is None,
            in_set=fits,
            utilization=used,
        )
    return result


def edf(tasks: Iterable[Timing]) -> dict[str, Assigned]:
    """Give every task one criticality, so that deadlines alone decide (6.2.3).

    Raises:
        ValueError: A period or an execution time is out of its range.
    """
    result: dict[str, Assigned] = {}
    used = 0.0
    for task in by_period(tasks):
        used += (task.maxc or 0.0) / task.period
        result[task.name] = Assigned(
            crit=INSIDE if task.crit is None else task.crit,
            assumed=False,
            in_set=False,
            utilization=used,
        )
    return result


def rm(freq: float, minfreq: float = 1.0, maxfreq: float = 1000.0) -> int:
    """Return the criticality of a rate: 62 bands of equal ratio (section 4.5.1).

    Rates up to `minfreq` get 1, rates from `maxfreq` on get 62. Rates in one band get
    the same criticality; the dispatcher then goes by deadline.

    Args:
        freq: Hz, above 0.
        minfreq: Hz, above 0.
        maxfreq: Hz, above `minfreq`.

    Raises:
        ValueError: A frequency is out of its range.
    """
    if not 0 < minfreq < maxfreq < math.inf:
        msg = f"MINFREQ {minfreq} Hz and MAXFREQ {maxfreq} Hz span no range"
        raise ValueError(msg)
    if not freq > 0:
        msg = f"frequency {freq} Hz is not above zero"
        raise ValueError(msg)
    if freq <= minfreq:
        return 1
    if freq >= maxfreq:
        return RM_LEVELS
    band = math.log(freq / minfreq) / math.log(maxfreq / minfreq)
    return 1 + min(RM_LEVELS - 1, int(RM_LEVELS * band))


def rate_monotonic(
    tasks: Iterable[Timing], minfreq: float = 1.0, maxfreq: float = 1000.0
) -> dict[str, Assigned]:
    """Give every task the criticality of its rate (`rm`).

    Whether a task belongs to the critical set follows from equation 9: the first S
    tasks whose utilization is within S * (2**(1/S) - 1).

    Raises:
        ValueError: A period, an execution time or a frequency is out of its range.
    """
    result: dict[str, Assigned] = {}
    used, fits, unknown = 0.0, True, False
    for count, task in enumerate(by_period(tasks), 1):
        unknown = unknown or task.maxc is None
        used += (task.maxc or 0.0) / task.period
        fits = fits and used <= liu_layland(count) * (1 + 1e-12)
        rule = rm(1.0 / task.period, minfreq, maxfreq)
        result[task.name] = Assigned(
            crit=rule if task.crit is None else task.crit,
            assumed=False,
            in_set=fits and not unknown,
            utilization=used,
        )
    return result


def liu_layland(count: int) -> float:
    """Return the utilization up to which RM always schedules `count` tasks (eq. 9).

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        msg = f"{count} tasks have no bound"
        raise ValueError(msg)
    return count * (2 ** (1 / count) - 1)
