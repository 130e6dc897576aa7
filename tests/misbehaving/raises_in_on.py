"""Raises in `on`."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Raises(PortBasedObject):
    """Fails in `on`, after ten cycles if it gets that far."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def on(self) -> None:
        raise ValueError("on does not work")

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
