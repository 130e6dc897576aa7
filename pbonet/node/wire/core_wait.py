"""Measures how long a process was ready to run and did not get its core."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

from .process_setup import stat


class MainThreadTimes(NamedTuple):
    """Times of a process's main thread that the kernel has counted, in nanoseconds."""

    ran: int
    """Time on a core."""
    ready: int
    """Time from being ready to running; what it waits now is not in it yet."""


def main_thread_times(pid: int) -> MainThreadTimes | None:
    """Return the times of a process's main thread.

    None: the kernel does not count them, or the process is gone.
    """
    try:
        text = Path(f"/proc/{pid}/task/{pid}/schedstat").read_text(encoding="ascii")
        ran, ready, _ = map(int, text.split())
    except (OSError, ValueError):
        return None
    return MainThreadTimes(ran, ready)


class CoreWait:
    """Counts from now on how long a process waits for its core.

    Args:
        pid: The process.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._first = main_thread_times(pid)
        self._last, self._since = self._first, time.monotonic_ns()

    @property
    def known(self) -> bool:
        """Whether the kernel counts it, and there is the process."""
        return self._first is not None

    def seconds(self) -> float:
        """Return for how long it was ready and did not run; 0 if that is unknown.

        What passes until it runs is not counted by the kernel yet. It is counted here
        from the first call on that has found it ready, so call this often.
        """
        ready = (process := stat(self._pid)) is not None and process.state == "R"
        now, at = main_thread_times(self._pid), time.monotonic_ns()
        if not ready or now != self._last:
            self._last, self._since = now, at
        if self._first is None or now is None:
            return 0.0
        return (now.ready - self._first.ready + at - self._since) * 1e-9
