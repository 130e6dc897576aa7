"""A good neighbour: counts its cycles and keeps a diary."""

import os
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Notes(Params):
    """Where the diary is kept."""

    diary: A[str, param("none", "file that every method but cycle adds a line to")] = ""


class Counts(PortBasedObject[Notes]):
    """y = (cycles, missed cycles as dt shows them)."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles, and missed ones")]

    def init(self) -> None:
        self._note("init")

    def on(self) -> None:
        self._note("on")
        self.y[:] = 0.0

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self.y[1] += round(dt * self.task.freq) - 1

    def off(self) -> None:
        self._note(f"off {self.task.handover}")

    def kill(self) -> None:
        self._note("kill")

    def reinit(self) -> None:
        self._note("reinit")

    def _note(self, text: str) -> None:
        if self.params.diary:
            line = f"{self.task.now} {os.getpid()} {text}\n"
            with Path(self.params.diary).open("a") as diary:
                diary.write(line)
