"""A good neighbour: writes the time by a clock that all hosts share."""

import time
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class TellsTime(PortBasedObject):
    """y = (time of the cycle in seconds, 0)."""

    y: A[Vector, OutVar("Y", "2", "none", "seconds since 1970, 0")]

    def cycle(self, dt: float) -> None:
        self.y[0] = time.time()
