"""Fails in every cycle, and handles it in the way it is told."""

from typing import Annotated as A, Literal

from pbonet import Handling, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import DeviceError

HOT = 7


class Way(Params):
    """How."""

    way: A[
        Literal["continue", "jump", "kept", "none"], param("none", "what handles it")
    ]


class Handles(PortBasedObject[Way]):
    """y = (cycles, errors)."""

    y: A[Vector, OutVar("Y", "2", "none", "whole cycles, and errors")]

    def init(self) -> None:
        if self.params.way == "kept":
            self.task.always_on_error(OSError, self._count)

    def on(self) -> None:
        self.y[:] = 0.0

    def _count(self, _error: Exception) -> Handling:
        self.y[1] += 1.0
        return Handling[self.params.way.upper().replace("KEPT", "JUMP")]

    def cycle(self, dt: float) -> None:
        if self.params.way in {"continue", "jump"}:
            with self.task.on_error(HOT, self._count):
                self.task.fail("too hot", HOT)
        elif self.y[0] % 2 or self.params.way == "none":
            self.y[0] += 1.0
            raise DeviceError("no encoder")
        self.y[0] += 1.0
