"""Sleeps in `cycle`, for longer than its period."""

import time
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Waits(PortBasedObject):
    """Waits 20 ms in each cycle and computes next to nothing."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        time.sleep(0.02)
