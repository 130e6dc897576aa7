"""Hangs in native code that holds the interpreter."""

from itertools import repeat
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Hangs(PortBasedObject):
    """Never comes back from a C loop that looks at no signal."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0:
            sum(repeat(0))
