"""Hangs in its first `cycle`, in Python code that leaves others the processor."""

import time
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Where(Params):
    """What it writes."""

    begun: A[str, param("none", "written when the first cycle begins")]


class Hangs(PortBasedObject[Where]):
    """Never comes back from any `cycle`."""

    y: A[Vector, OutVar("Y", "2", "none", "nothing")]

    def cycle(self, dt: float) -> None:
        Path(self.params.begun).touch()
        while True:
            time.sleep(0.005)
