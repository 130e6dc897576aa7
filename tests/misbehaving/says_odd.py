"""Says what is hard to tell: floods, texts without end, no Unicode, numpy numbers."""

from typing import Annotated as A

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Odd(Params):
    """What it says."""

    text: A[str, param("none", "what its error says: long, odd or mute")]
    warnings: A[int, param("none", "how many come before the error", ge=0)] = 0


class MuteError(Exception):
    """An error whose text cannot be had."""

    def __str__(self) -> str:
        raise LookupError("no words")


class SaysOdd(PortBasedObject[Odd]):
    """Counts to ten, then raises; `get` gives numbers of numpy, or what is none."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0 and self.params.text != "nothing":
            for _ in range(self.params.warnings):
                self.task.warn("something is wrong with the sensor of this axis")
            if self.params.text == "mute":
                raise MuteError
            raise ValueError(self.text())

    def text(self) -> str:
        if self.params.text == "long":
            return "x" * 250_000
        return "cannot read " + b"/nowhere/\xff.dat".decode(errors="surrogateescape")

    def get(self, name: str) -> object:
        return np.float64(1.5) if name == "warnings" else object()
