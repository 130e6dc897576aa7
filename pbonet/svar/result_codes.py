"""Numbers that the C headers answer with."""

from __future__ import annotations

from enum import IntEnum, IntFlag

RIVAL, FULL, STUCK, ALIVE = -1, -2, -3, -4
"""Of changes of ownership; 0 is good."""

CONSTS, IN, ON = range(3)
"""Plans: what a copy brings."""

VARS, OUT_CONSTS = range(2)
"""Groups: what is written together."""


class Verdict(IntEnum):
    """Result of examining a file."""

    SOUND = 0
    NO_TABLE = 1
    OTHER_VERSION = 2
    CUT_SHORT = 3
    DAMAGED = 4
    MOVING_PART = 5
    """Behind the static part; not the header's judgement, but that of a first look."""


class Flags(IntFlag):
    """Result of a copy or a commit; 0 is success."""

    COPY_TORN = 1
    """The retry bound was met: groups are whole, the cut is not proven consistent."""
    COPY_STALE = 2
    """An input is older than its MAXAGE, or was never written."""
    COPY_KEPT = 4
    """With TORN: the inputs of the last copy were kept, as the task asked for."""
    COPY_LOST = 8
    """With TORN: a group was not had whole in 256 tries; do not use the inputs."""
    COMMIT_NONFINITE = 16
    """Nothing was committed: a float is NaN or infinite."""
    COMMIT_LIMIT = 32
    """Nothing was committed: a value is outside MIN and MAX, with LIMIT error."""
    COMMIT_NOT_OWNER = 64
    """Nothing was committed: the task has not claimed its variables."""
