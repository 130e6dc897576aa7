"""Has a cycle without end, one after the other: its `sync` does not wait."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class NeverWaits(PortBasedObject):
    """Behaves as if an event was always there."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def sync(self) -> None:
        """Return at once."""

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
