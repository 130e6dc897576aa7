"""Calls a C extension in its tenth cycle that brings the process down."""

import ctypes
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class How(Params):
    """Which way."""

    library: A[str, param("none", "the extension: tests/native/crashes.c, compiled")]
    function: A[str, param("none", "what to call, such as sigfpe")]


class Crashes(PortBasedObject[How]):
    """Brings its own process down, in C."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        library = ctypes.PyDLL(self.params.library)
        self._crash = getattr(library, self.params.function)

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0:
            self._crash()
