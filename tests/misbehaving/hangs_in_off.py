"""Hangs in `off`, in Python code."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Hangs(PortBasedObject):
    """Never comes back from `off`."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def off(self) -> None:
        while True:
            pass

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
