"""Is killed from outside, by itself for want of somebody else."""

import os
import signal
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Dies(PortBasedObject):
    """Ends in its tenth cycle, without a word."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0:
            os.kill(os.getpid(), signal.SIGKILL)
