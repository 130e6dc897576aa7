"""Reads address zero in `off`."""

import ctypes
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Segfaults(PortBasedObject):
    """Brings its own process down when it is to end."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0

    def off(self) -> None:
        ctypes.string_at(0)
