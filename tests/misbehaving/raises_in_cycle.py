"""Raises in `cycle`."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Raises(PortBasedObject):
    """Fails in `cycle`, after ten cycles if it gets that far."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0:
            self.y[1] = 1.0
            raise ZeroDivisionError("the tenth cycle does not work")
