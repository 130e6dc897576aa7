"""An event that never ends: for servers and background tasks."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class HangsWhenServed(PortBasedObject):
    """Computes without end once its first event has come."""

    y: A[Vector, OutVar("Y", "2", "none", "nothing")]

    def sync(self) -> None:
        """An event is always there."""

    def cycle(self, dt: float) -> None:
        while True:
            self.y[0] += dt
