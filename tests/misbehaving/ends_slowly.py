"""Takes half a second to end."""

import time
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class EndsSlowly(PortBasedObject):
    """y = 0."""

    y: A[Vector, OutVar("Y", "2", "none", "nothing")]

    def cycle(self, dt: float) -> None:
        pass

    def kill(self) -> None:
        time.sleep(0.5)
