"""Meaning of the records of the dispatcher's trace (`records.Decision`)."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .records import Decision


class Event(IntEnum):
    """Kind of a record of the trace; ``a``, ``b`` and ``arg`` are its arguments."""

    TURN = 1
    """Heads each turn: at instant a; the next event is at b (0: none); arg 1: park."""
    LIFE = 2
    """Input: the slot was allocated (arg odd) or freed (arg even); a is 1 when its task
    has died while it was ON or was in ERROR, which may not have been seen."""
    CONFIG = 3
    """Input: period a, relative deadline b (0: period), arg: criticality in bits 0 to
    7, priority in 8 to 23, `Kind` in 24 to 30; bit 31 says that the task is in another
    process now, which holds no level."""
    DEAD = 4
    """Input: the task's process is gone, or an orphan, which is not ranked."""
    MODE = 5
    """Input: the task's mode word arg (`Mode`, arming count, return count); a is 1 when
    it is OFF because it is in ERROR."""
    DONE = 6
    """Input: the granted cycle has ended. With arg, the task has released itself arg
    times since, the sole ready one of its core; it runs the cycle of the release at a,
    before which its CPU clock stood at b (0: not read)."""
    BEGUN = 7
    """Input: the granted cycle has started and not ended; arg 1: it hangs."""
    LEAD = 8
    """Input: process a leads from now on; no task is known to hold a level."""
    LIMITS = 9
    """Input: MINC a, reserve b, arg: criticality when it is used up in bits
    0 to 7, that of the handler in 8 to 15, and in bit 16 whether there is a handler."""
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
    """Input: the slot waits for the slots that are bits of a (0 to 63) and b; arg 0:
    for nothing, 1: until one is in ERROR or has died, 2: until all are off."""
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
    """Decision: let a held task continue."""
    FAIL = 22
    """Decision: a timing failure of kind arg & 3 at instant a; arg bit 8: report it;
    bit 9: make the out-vars safe."""
    CRIT = 23
    """Decision: the task has criticality arg from here on."""
    SKIP = 24
    """Decision: grant number arg must not be started any more."""
    REFILL = 25
    """Decision: a server gets capacity a back, and has b."""
    FORCE = 26
    """Decision: a critical section of grant arg has lasted too long; failures come."""
    ENGAGE = 27
    """Decision: a task that stands by runs its `on`, from a on, with deadline b."""


def turns(
    trace: Iterable[Decision],
) -> Iterable[tuple[Decision, list[Decision], list[Decision]]]:
    """Split a trace into turns: the head, the inputs, the decisions."""
    head: Decision | None = None
    inputs: list[Decision] = []
    decisions: list[Decision] = []
    for record in trace:
        if record.kind == Event.TURN:
            if head is not None:
                yield head, inputs, decisions
            head, inputs, decisions = record, [], []
        elif record.kind < Event.RELEASE:
            inputs.append(record)
        else:
            decisions.append(record)
    if head is not None:
        yield head, inputs, decisions
