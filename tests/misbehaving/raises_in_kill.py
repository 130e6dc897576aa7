"""Raises in `kill`."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Raises(PortBasedObject):
    """Fails in `kill`, after ten cycles if it gets that far."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0

    def kill(self) -> None:
        raise KeyError("kill does not work")
