"""Hangs in `cycle`, in Python code."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Hangs(PortBasedObject):
    """Never comes back from `cycle`."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        while self.y[0] == 10.0:
            pass
