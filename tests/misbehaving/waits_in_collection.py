"""What its `off` leaves waits for a file when it is collected as garbage."""

import time
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Files(Params):
    """By which files it is steered."""

    begun: A[str, param("none", "written when the collection begins")]
    go_on: A[str, param("none", "the collection ends when it is there")]


class Litter:
    """Refers to itself, so that only a collection ends it."""

    def __init__(self, files: Files) -> None:
        self._files, self._self = files, self

    def __del__(self) -> None:
        Path(self._files.begun).touch()
        while not Path(self._files.go_on).exists():
            time.sleep(0.005)


class Leaves(PortBasedObject[Files]):
    """Leaves garbage in `off`."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0

    def off(self) -> None:
        Litter(self.params)
