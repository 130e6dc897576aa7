"""Calls `sys.exit` in its tenth cycle."""

import sys
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Exits(PortBasedObject):
    """Believes that it is a program."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0:
            sys.exit(3)
