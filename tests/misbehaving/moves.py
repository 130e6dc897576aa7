"""A robot interface: it turns what it reads into motion, as far as anybody knows."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Moves(PortBasedObject, module_class="robot interface"):
    """y counts the cycles."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0

    def stable(self, dt: float) -> None:
        self.y[1] += 1.0
