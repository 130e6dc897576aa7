"""A good neighbour: counts on from what it finds."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class CountsOn(PortBasedObject):
    """y = (the count, what it was as the task came on)."""

    y: A[Vector, OutVar("Y", "2", "none", "the count, and what was found")]

    def on(self) -> None:
        self.y[1] = self.y[0]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
