"""Takes its time to end."""

import time
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Lingers(PortBasedObject):
    """y = 0."""

    y: A[Vector, OutVar("Y", "2", "none", "nothing")]

    def cycle(self, dt: float) -> None:
        pass

    def kill(self) -> None:
        time.sleep(0.5)
