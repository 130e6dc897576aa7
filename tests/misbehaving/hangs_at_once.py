"""Hangs in its first `cycle`, in Python code."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Hangs(PortBasedObject):
    """Never comes back from any `cycle`."""

    y: A[Vector, OutVar("Y", "2", "none", "nothing")]

    def cycle(self, dt: float) -> None:
        while True:
            pass
