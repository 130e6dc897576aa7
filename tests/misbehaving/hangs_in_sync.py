"""Computes in `sync`, where it should wait."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class HangsInSync(PortBasedObject):
    """Never comes back from its third `sync`."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        self._waits = 0

    def sync(self) -> None:
        self._waits += 1
        while self._waits == 3:
            pass

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
