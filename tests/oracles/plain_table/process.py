"""Twin of what lock.h asks about time and processes."""

from __future__ import annotations

import os
import time
from pathlib import Path

UNKNOWN = (1 << 64) - 1
"""When a process started that cannot be looked at."""


def now_ns() -> int:
    """Return CLOCK_MONOTONIC."""
    return time.monotonic_ns()


def process_start(pid: int) -> int:
    """Return when the process started, in ticks since boot; 0 when it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return _unseen(pid)
    return 0 if fields[0] in "ZX" else int(fields[19])


def _unseen(pid: int) -> int:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return 0
    except OSError:
        pass
    return UNKNOWN


def space() -> int:
    """Return the name space in which process numbers mean something."""
    return Path("/proc/self/ns/pid").stat().st_ino


def lives(pid: int, start: int) -> bool:
    """Return whether a process lives; who cannot be judged counts as alive."""
    now = process_start(pid)
    return now in {start, UNKNOWN} or (now != 0 and start == UNKNOWN)


def survive_cuts() -> bool:
    """Say that this twin cannot keep a process alive whose table is cut short."""
    return False
