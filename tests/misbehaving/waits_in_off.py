"""Waits in `off` for a file: what else happens meanwhile is the test's to say."""

import time
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Files(Params):
    """By which files it is steered."""

    begun: A[str, param("none", "written when `off` begins")]
    go_on: A[str, param("none", "`off` ends when it is there")]


class Waits(PortBasedObject[Files]):
    """Ends `off` when it may."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0

    def off(self) -> None:
        Path(self.params.begun).touch()
        while not Path(self.params.go_on).exists():
            time.sleep(0.005)
