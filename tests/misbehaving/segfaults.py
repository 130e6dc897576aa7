"""Reads address zero in its tenth cycle."""

import ctypes
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Segfaults(PortBasedObject):
    """Brings its own process down."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0:
            ctypes.string_at(0)
