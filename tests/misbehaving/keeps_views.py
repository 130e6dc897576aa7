"""Keeps views of its variables, and uses them when they are not its own any more."""

import atexit
from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector

KEPT = []


class KeepsViews(PortBasedObject):
    """Reads and writes the views as its process ends."""

    z: A[Vector, InVar("Z", "2", "none", "nothing")]
    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def on(self) -> None:
        KEPT[:] = [self.z[:], self.y[1:], memoryview(self.y)]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0

    def off(self) -> None:
        atexit.register(use)


def use() -> None:
    KEPT[1][0] = 1e9 + KEPT[0].sum()
    KEPT[2][0] = 1e9
