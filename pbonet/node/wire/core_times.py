"""The use of a core's time, by the kernel's own counts.

They say what no task can: that the hypervisor took the core, that interrupts or other
programs had it, or that even the dispatcher had to wait for it.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Final, NamedTuple

_MS_PER_TICK: Final = 1000.0 / os.sysconf("SC_CLK_TCK")


class _Counts(NamedTuple):
    at: float
    """Seconds of CLOCK_MONOTONIC."""
    ticks: tuple[int, ...]
    """As in the core's line of ``/proc/stat``; empty where it cannot be read."""
    waited_ns: int | None
    """For how long a thread was ready without running; None: the kernel says not."""


class CoreTimes:
    """Says what a core did between two readings.

    Args:
        core: Its number.
        proc: Where the kernel's files are.
    """

    def __init__(self, core: int, proc: Path = Path("/proc")) -> None:
        self._core, self._proc = core, proc
        self._last: _Counts | None = None
        self._thread = (0, 0)

    def read(self, pid: int, tid: int) -> str:
        """Return what the core did since the last reading; empty if nothing is known.

        Args:
            pid: Process of the dispatcher that leads.
            tid: Its thread, which waits for the core only if the kernel, an interrupt
                or the hypervisor has it.
        """
        now = _Counts(time.monotonic(), self._ticks(), self._waited(pid, tid))
        before, self._last = self._last, now
        same, self._thread = self._thread == (pid, tid), (pid, tid)
        if before is None:
            return ""
        parts: list[str] = []
        if now.ticks and before.ticks:
            user, nice, system, idle, iowait, irq, softirq, stolen = (
                (b - a) * _MS_PER_TICK
                for a, b in zip(before.ticks, now.ticks, strict=True)
            )
            parts.append(
                f"busy {user + nice + system:.0f} ms, idle {idle + iowait:.0f} ms, "
                f"interrupts {irq + softirq:.0f} ms, stolen by the hypervisor "
                f"{stolen:.0f} ms"
            )
        if same and None not in {now.waited_ns, before.waited_ns}:
            waited = (now.waited_ns or 0) - (before.waited_ns or 0)
            parts.append(f"its dispatcher waited {waited / 1e6:.2f} ms for it")
        if not parts:
            return ""
        return f"core {self._core} in {now.at - before.at:.2f} s: {'; '.join(parts)}"

    def _ticks(self) -> tuple[int, ...]:
        name = f"cpu{self._core}"
        try:
            with (self._proc / "stat").open(encoding="ascii") as lines:
                for line in lines:
                    words = line.split()
                    if words[0] == name:
                        return tuple(map(int, words[1:9]))
        except (OSError, ValueError):
            pass
        return ()

    def _waited(self, pid: int, tid: int) -> int | None:
        try:
            text = (self._proc / f"{pid}/task/{tid}/schedstat").read_text("ascii")
            return int(text.split()[1])
        except (OSError, ValueError, IndexError):
            return None
