"""Allocates memory in every cycle until the kernel gives no more."""

import resource
from pathlib import Path
from typing import Annotated as A

import numpy as np

from pbonet import OutVar, PortBasedObject, Vector

LIMIT = 1 << 28
STEP = 1 << 23


class EatsMemory(PortBasedObject):
    """Has an address space of 256 MiB more, so that it does no harm in a test."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = pages * resource.getpagesize() + LIMIT
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        self._eaten = []

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self._eaten.append(np.ones(STEP // 8))
