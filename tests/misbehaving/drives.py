"""Drives something, and notes when it begins to, is stable, and ends."""

import time
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Notes(Params):
    """Where it notes that."""

    diary: A[str, param("none", "file that each change adds a line to")]


class Drives(PortBasedObject[Notes]):
    """y = (cycles, 1), and (cycles, -1) while the configuration is illegal."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles, and whether it drives")]

    def on(self) -> None:
        self._does = ""

    def cycle(self, dt: float) -> None:
        self._note("cycle")
        self.y[:] = self.y[0] + 1.0, 1.0

    def stable(self, dt: float) -> None:
        self._note("stable")
        self.y[1] = -1.0

    def off(self) -> None:
        self._note("off")

    def _note(self, what: str) -> None:
        if what != self._does:
            self._does = what
            with Path(self.params.diary).open("a") as diary:
                diary.write(f"{time.monotonic()} {what}\n")
