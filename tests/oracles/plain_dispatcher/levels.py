"""FIFO levels for ranked tasks: the twin of ``muf_assign`` in ``muf.h``.

The ready tasks hold SCHED_FIFO levels as *ordered labels*: what counts is their order,
so a task keeps the level it had while that still lies between its neighbours', and
hardly any release needs a system call.
"""

from __future__ import annotations

from bisect import bisect_left

LOW, HIGH = 7, 84
"""SCHED_FIFO levels of cycles; commands are below (6), the dispatcher above (95)."""
BACKGROUND = (1, 4)
"""Lowest and highest level of background tasks, below commands and links."""


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
