"""Keeps a machine's processors awake: more power for shorter wake-up latency.

An idle processor sleeps, more deeply the longer it may take to wake. A program can ask
the kernel for no latency at all: as long as it holds this file open, idle processors
poll for work instead (Linux, `pm_qos_interface`).
"""

from __future__ import annotations

import os
from pathlib import Path

DEVICE = Path("/dev/cpu_dma_latency")
_NO_TIME = bytes(4)
"""Microseconds that waking may take, in the kernel's format."""


class IdleStateLock:
    """Keeps the processors awake until it is closed, or the process ends."""

    def __init__(self) -> None:
        self._fd = -1
        self.limits: list[str] = []
        """The reason why they sleep anyway, for the report of the node's limits."""
        try:
            self._fd = os.open(DEVICE, os.O_WRONLY | os.O_CLOEXEC)
            os.write(self._fd, _NO_TIME)
        except OSError as error:
            self.close()
            self.limits.append(
                f"the processors sleep when they are idle: {DEVICE}: {error.strerror}; "
                "let the agent's user write it, or leave 'awake' out"
            )

    def close(self) -> None:
        """Let them sleep again."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
