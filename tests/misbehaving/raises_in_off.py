"""Raises in `off`."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Raises(PortBasedObject):
    """Fails in `off`, after ten cycles if it gets that far."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0

    def off(self) -> None:
        raise KeyError("off does not work")
