"""A time integrator."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.modules._values import PerElement, bounds


class Range(Params):
    """Limits of the integral."""

    lower: A[PerElement, param("none", "smallest value, in the unit of Z")]
    upper: A[PerElement, param("none", "largest value, in the unit of Z")]


class Integrator(PortBasedObject[Range], module_class="signal"):
    """z += z_dot * dt, within the limits.

    The integral goes on from wherever Z stands when the module is turned on, so it
    takes over from another producer of Z without a step. A value that begins beyond a
    limit may come back, but not go further.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z_dot: A[Vector, InVar("Z^", "ndof", "any", "the input")]
    z: A[Vector, OutVar("Z", "ndof", "any", "its time integral")]

    def init(self) -> None:
        self._take_limits()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - both at once
        self._take_limits()

    def cycle(self, dt: float) -> None:
        low = np.minimum(self._lower, self.z)
        high = np.maximum(self._upper, self.z)
        (self.z + self.z_dot * dt).clip(low, high, out=self.z)

    def _take_limits(self) -> None:
        k, n = self.params, self.ndof
        self._lower, self._upper = bounds(k.lower, k.upper, n)
