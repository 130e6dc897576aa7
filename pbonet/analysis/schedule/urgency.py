"""Urgency: one number per ready task, and the levels that make the kernel obey it.

The urgency value is criticality, deadline and user priority side by side, as in Figure
6.2 of Stewart 1994; equal values are served first come, first served. The ready tasks,
ranked by it, hold SCHED_FIFO levels as *ordered labels*: what counts is their order, so
a task keeps the level it had while that still lies between its neighbours', and hardly
any release needs a system call. `pbonet/node/rt/muf.h` is the same in C.
"""

from __future__ import annotations

from bisect import bisect_left

LOW, HIGH = 4, 84
"""SCHED_FIFO levels of cycles; commands are below (3), the dispatcher above (95)."""
NEVER = (1 << 63) - 1
"""The deadline of a task that has none: a dynamic priority of zero."""
PRIORITY_BITS = 16
DEADLINE_BITS = 63
CRIT_MAX = 63
PRIORITY_MAX = (1 << PRIORITY_BITS) - 1


def urgency(crit: int, deadline_ns: int, priority: int) -> int:
    """Return the urgency value; the greater one runs first (section 6.2.3).

    Args:
        crit: Criticality, 0 to 63.
        deadline_ns: Absolute, CLOCK_MONOTONIC; `NEVER` for none. The thesis counts
            milliseconds from now in 20 bits; absolute nanoseconds order the same way
            and need no renewal as time goes by.
        priority: User priority, 0 to 65535.

    Raises:
        ValueError: A value is out of its range.
    """
    if not 0 <= crit <= CRIT_MAX:
        msg = f"criticality {crit} is not within 0 to {CRIT_MAX}"
        raise ValueError(msg)
    if not 0 <= deadline_ns <= NEVER:
        msg = f"deadline {deadline_ns} ns is not within 0 to {NEVER}"
        raise ValueError(msg)
    if not 0 <= priority <= PRIORITY_MAX:
        msg = f"user priority {priority} is not within 0 to {PRIORITY_MAX}"
        raise ValueError(msg)
    dynamic = NEVER - deadline_ns
    return (crit << DEADLINE_BITS | dynamic) << PRIORITY_BITS | priority


def assign_levels(held: list[int], low: int = LOW, high: int = HIGH) -> list[int]:
    """Return a level for each ready task, changing as few of them as can be.

    Args:
        held: The level that each task holds, most urgent task first; 0 for none.
        low: The lowest level to give.
        high: The highest level to give.

    Returns:
        Levels that strictly decrease. If there are more tasks than levels, the least
        urgent ones share `low`; the kernel then serves them first come, first served.
    """
    count, room = len(held), high - low + 1
    if count > room:
        head = assign_levels(held[: room - 1], low + 1, high)
        return head + [low] * (count - room + 1)
    kept = _keep(held, low + count - 1, high)
    levels = list(held)
    above, level_above = -1, high + 1
    for below in (*kept, count):
        level_below = held[below] if below < count else low - 1
        gap, span = below - above, level_above - level_below
        for step in range(1, gap):
            levels[above + step] = level_above - step * span // gap
        above, level_above = below, level_below
    return levels


def _keep(held: list[int], floor: int, ceiling: int) -> list[int]:
    """Return the places whose levels can stay so that all the others fit between.

    Level plus place is the measure: two levels can both stay if it does not rise from
    the upper to the lower one, for then enough levels lie between them. The longest
    such choice is the longest non-rising subsequence.
    """
    measure = [level + place for place, level in enumerate(held)]
    ends: list[int] = []  # negated measure of the best chain of each length: rises
    last: list[int] = []  # the place where that chain ends
    before = [-1] * len(held)
    for place, value in enumerate(measure):
        if not floor <= value <= ceiling:
            continue
        length = _first_below(ends, value)
        before[place] = last[length - 1] if length else -1
        if length == len(ends):
            ends.append(-value)
            last.append(place)
        else:
            ends[length], last[length] = -value, place
    chain: list[int] = []
    place = last[-1] if last else -1
    while place >= 0:
        chain.append(place)
        place = before[place]
    return chain[::-1]


def _first_below(ends: list[int], value: int) -> int:
    """Return the first chain length whose best end is lower than `value`."""
    return bisect_left(ends, 1 - value)
