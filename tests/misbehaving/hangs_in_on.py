"""Hangs in `on`, in Python code."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Hangs(PortBasedObject):
    """Never comes back from `on`."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def on(self) -> None:
        print("in on", flush=True)
        while True:
            pass

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
