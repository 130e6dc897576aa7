"""Meaning of the records of the dispatcher's trace (`records.Decision`)."""

from __future__ import annotations

from enum import IntEnum


class Event(IntEnum):
    """Kind of a record of the trace; ``a``, ``b`` and ``arg`` are its arguments."""

    TURN = 1
    """Heads each turn: at instant a; the next event is at b (0: none); arg 1: park."""
    LIFE = 2
    """Input: the slot was allocated (arg odd) or freed (arg even); a is 1 when its task
    has died while it was ON or was in ERROR, which may not have been seen."""
    CONFIG = 3
    """Input: period a, relative deadline b (0: period), arg packed by `pack`; its bit
    31 tells of another process, which holds no level."""
    DEAD = 4
    """Input: the task's process is gone, or an orphan, which nobody ranks."""
    MODE = 5
    """Input: the task's mode word arg (`Mode`, arming count, return count); a is 1 when
    it is OFF because it is in ERROR."""
    DONE = 6
    """Input: the granted cycle has ended."""
    BEGUN = 7
    """Input: the granted cycle has begun and not ended."""
    LEAD = 8
    """Input: process a leads from now on; no task is known to hold a level."""
    LIMITS = 9
    """Input: MINC a, reserve b, arg packed by `pack_limits`."""
    USED = 10
    """Input: the task's CPU clock stands at a; arg 1: in a critical section."""
    HANDLED = 11
    """Input: the failure handler has ended."""
    WISH = 12
    """Input: the handler wants criticality arg (255: none), deadline a (0: none)."""
    EVENT = 13
    """Input: something came from outside at instant a; arg 1: it is being served."""
    UNLOCKED = 14
    """Input: the critical section that held a drop off has ended."""
    AFTER = 15
    """Input: the slot stands by (arg: `After`) for bits of a (slots 0 to 63) and b."""
    RELEASE = 16
    """Decision: the release at instant a, deadline b."""
    MISS = 17
    """Decision: arg releases have no cycle of their own."""
    LEVEL = 18
    """Decision: give the task FIFO level arg."""
    WAKE = 19
    """Decision: grant cycle number arg to the task and wake it."""
    PARK = 20
    """Decision: hold the task where it is."""
    RESUME = 21
    """Decision: let a held task go on."""
    FAIL = 22
    """Decision: a timing failure of kind arg & 3 at instant a; arg bit 8: tell it."""
    CRIT = 23
    """Decision: the task has criticality arg from here on."""
    SKIP = 24
    """Decision: grant number arg must not be begun any more."""
    REFILL = 25
    """Decision: a server gets capacity a back, and has b."""
    FORCE = 26
    """Decision: a critical section of grant arg has lasted too long; failures come."""
    ENGAGE = 27
    """Decision: a task that stands by runs its `on`, from a on, with deadline b."""


class After(IntEnum):
    """The event that engages a task that stands by."""

    ALONE = 0
    """Nothing yet."""
    FALLBACK = 1
    """One of some slots goes to ERROR, or dies while it is armed."""
    HANDOVER = 2
    """Nothing more is missing: all who hand over to it have called."""


def pack(crit: int, priority: int, kind: int) -> int:
    """Return the arg of a CONFIG record."""
    return crit | priority << 8 | kind << 24


def pack_limits(drop: int, handler: int, *, tells: bool) -> int:
    """Return the arg of a LIMITS record."""
    return drop | handler << 8 | tells << 16
