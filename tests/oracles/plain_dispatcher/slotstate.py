"""What the dispatcher knows of one task: the twin of ``struct rt_state``."""

from __future__ import annotations

from msgspec import Struct, field

from pbonet.analysis.schedule.records import Mode

LAST, HUNG = 2, 3
"""A cycle goes last among equals; it does not return, and goes after all others."""


class SlotState(Struct):
    """What the dispatcher knows of one slot."""

    life: int = 0
    period: int = 1_000_000_000
    deadline: int = 0
    crit: int = 0
    priority: int = 0
    kind: int = 0
    word: int = 0
    dead: bool = False
    armed: bool = False
    ready: bool = False
    """A release is waiting for its cycle to end."""
    granted: bool = False
    """The task was told."""
    begun: bool = False
    overrun: int = 0
    """`LAST` or `HUNG` for a cycle that has used up its period, and more."""
    parked: bool = False
    level: int = 0
    seq: int = 0
    """Number of the last grant."""
    next_ns: int = 0
    rel_ns: int = 0
    dl_ns: int = 0
    missed: int = 0

    tells: bool = False
    safe_at: set[int] = field(default_factory=set)
    """Kinds of failure at which the out-vars get safe values."""
    """The module has a failure handler."""
    rank: int = 0
    """The criticality that the task has at this moment."""
    drop: int = 0
    handler: int = 0
    minc: int = 0
    maxc: int = 0
    clock: int = 0
    """The task's CPU clock when it was read last."""
    mark: int = 0
    """Where it stood when the present reserve began; -1: not known yet."""
    locked: bool = False
    fresh: bool = False
    """There is news on which the clock must be read."""
    spent: bool = False
    late: bool = False
    """The present deadline's failure was told."""
    sure: bool = False
    """MINC was granted, or its failure told."""
    skip: bool = False
    owed: bool = False
    """The drop waits for the end of a critical section."""
    locked_ns: int = 0
    handling: bool = False
    """The handler runs at its own priority."""
    handler_mark: int = 0
    told: int = 0
    check_ns: int = 0
    engaged: bool = False
    """It stood by and was granted its `on`."""
    fell: bool = False
    """It went to ERROR or died while it was armed."""
    after_kind: int = 0
    after: int = 0
    """Slots that it comes after, as bits."""
    active: bool = False
    """A server serves an event."""
    heard: int = 0
    """How often a device's task has begun and ended a cycle, as far as it was seen."""
    left: int = 0
    event_ns: int = 0
    pieces: list[list[int]] = field(default_factory=list[list[int]])
    """Instant and amount of capacity that comes back to a sporadic server."""
    failures: list[int] = field(default_factory=lambda: [0, 0, 0])
    overruns: int = 0
    held_off: int = 0

    @property
    def mode(self) -> Mode:
        """What the task asks for."""
        return Mode(self.word & 3)


def arms(word: int) -> int:
    """Return how often the task was armed, out of its mode word."""
    return word >> 2 & 0x7FFF


def returns(word: int) -> int:
    """Return how often the task came back from a command, out of its mode word."""
    return word >> 17
