"""Calibration of a sensor: raw numbers become a physical quantity."""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._values import PerElement, grid, spread, square


class Calibration(Params):
    """Offset and matrix, as a calibration sheet has them."""

    matrix: A[
        PerElement,
        param("none", "Z per RAW, row by row; or the diagonal; or one factor for all"),
    ]
    offset: A[PerElement, param("none", "value of RAW at which Z is 0")] = (0.0,)


class Calib(PortBasedObject[Calibration], module_class="sensor"):
    """z = M (raw - offset).

    RAW and Z may differ in size, such as six strain gauges and a wrench, or eight; the
    matrix has a row for each element of Z. A value that is not finite ends in ERROR.
    """

    raw: A[Vector, InVar("RAW", "nraw", "any", "what the sensor gives")]
    z: A[Vector, OutVar("Z", "nz", "any", "the quantity that it measures")]

    def init(self) -> None:
        self._take_matrix()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_matrix()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        np.matmul(self._matrix, self.raw - self._offset, out=self.z)

    def _take_matrix(self) -> None:
        k, n, nraw = self.params, self.z.size, self.raw.size
        if n == nraw:
            self._matrix = square(k.matrix, n, "matrix")
        else:
            self._matrix = grid(k.matrix, n, nraw, "matrix")
        self._offset = spread(k.offset, nraw, "offset")
