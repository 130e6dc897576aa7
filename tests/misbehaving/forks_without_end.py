"""Starts processes in every cycle, and never stops."""

import os
import signal
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class ForksWithoutEnd(PortBasedObject):
    """y[1] = processes started so far; every fourth one loses its parent."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles, and processes")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        for k in range(8):
            if os.fork() == 0:
                if k % 4 == 0 and os.fork():
                    os._exit(0)
                signal.pause()
            self.y[1] += 1.0
