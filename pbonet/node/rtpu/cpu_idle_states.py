"""Keeps a machine's processors awake, for who pays power for early wake-ups.

A processor with nothing to do sleeps, deeper the longer it may take to wake. The kernel
lets a program say that it may take no time at all: as long as the program holds this
file open, idle processors look for work instead (Linux, `pm_qos_interface`).
"""

from __future__ import annotations

import os
from pathlib import Path

DEVICE = Path("/dev/cpu_dma_latency")
_NO_TIME = bytes(4)
"""Microseconds that waking may take, as the kernel has them."""


class Awake:
    """Keeps the processors awake until it is closed, or the process ends."""

    def __init__(self) -> None:
        self._fd = -1
        self.limits: list[str] = []
        """Why they sleep all the same, for who is told what the node cannot do."""
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
