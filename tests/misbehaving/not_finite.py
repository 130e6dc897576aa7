"""Computes a value that is none."""

from typing import Annotated as A

import numpy as np

from pbonet import OutVar, PortBasedObject, Vector


class NotFinite(PortBasedObject):
    """y is NaN in the tenth cycle."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.y[0] == 10.0:
            self.y[1] = np.nan
