"""Takes half a second of CPU time in one cycle."""

import time
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class SlowOnce(PortBasedObject):
    """Computes for long in its tenth cycle, and comes back."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        end = time.process_time() + 0.5
        while self.y[0] == 10.0 and time.process_time() < end:
            pass
