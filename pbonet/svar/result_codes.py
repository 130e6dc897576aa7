"""Result codes of the C headers."""

from __future__ import annotations

from enum import IntEnum, IntFlag

RIVAL, FULL, STUCK, ALIVE, GONE = -1, -2, -3, -4, -5
"""Results of changes of ownership; 0 is success."""

PASSED_ON = 1 << 63
"""In the cycle of a stamp: the time is that of older data (register.h)."""

CONSTS, IN, ON = range(3)
"""Plans: sets of variables that are copied in."""

VARS, OUT_CONSTS = range(2)
"""Groups: sets of variables that are written together."""


class Verdict(IntEnum):
    """Result of examining a file."""

    SOUND = 0
    NO_TABLE = 1
    OTHER_VERSION = 2
    CUT_SHORT = 3
    DAMAGED = 4


class Flags(IntFlag):
    """Result of a copy or a commit; 0 is success."""

    COPY_TORN = 1
    """The retry limit was reached: groups are whole, the cut is not proven."""
    COPY_STALE = 2
    """An input is older than its MAXAGE, or was never written."""
    COPY_KEPT = 4
    """With TORN: the inputs of the last copy were kept, as requested."""
    COPY_LOST = 8
    """With TORN: a group could not be copied whole in 256 tries; do not use inputs."""
    COMMIT_NONFINITE = 16
    """Nothing was committed: a float is NaN or infinite."""
    COMMIT_LIMIT = 32
    """Nothing was committed: a value is outside MIN and MAX, with LIMIT error."""
    COMMIT_NOT_OWNER = 64
    """Nothing was committed: the task has not claimed its variables."""
    TABLE_OVERWRITTEN = 128
    """Nothing was copied or committed: the table was overwritten."""
    COPY_SETTLING = 256
    """Inputs that were stale are fresh again, but not for long enough."""
    COMMIT_LATE = 512
    """Nothing was committed: the cycle has failed in time, and safe values were."""
