"""Time derivative of any signal (Stewart 1994, Figure 3.12)."""

from math import exp
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


class Smoothing(Params):
    """Smoothing of noise and of the steps of a slower producer."""

    tau: A[float, param("s", "time constant of each of two lags", ge=0)] = 0.0


class Diff(PortBasedObject[Smoothing], module_class="signal"):
    """z_dot = dz/dt by backward difference, smoothed by two first-order lags.

    A reference that is written at half this module's rate looks like a staircase:
    its plain difference would alternate between twice the slope and zero. Two lags of
    a few periods of the slower task make that a slope again, and come late by twice
    their time constant.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z: A[Vector, InVar("Z", "ndof", "any", "the input")]
    z_dot: A[Vector, OutVar("Z^", "ndof", "any", "its time derivative")]

    def init(self) -> None:
        self._before = np.zeros_like(self.z)
        self._once = np.zeros_like(self.z)  # after the first lag

    def on(self) -> None:
        self._before[:] = self.z
        self._once[:] = self.z_dot  # by any writer: no step at a swap

    def cycle(self, dt: float) -> None:
        tau = self.params.tau
        share = 1.0 - exp(-dt / tau) if tau else 1.0
        self._once += share * ((self.z - self._before) / dt - self._once)
        self.z_dot += share * (self._once - self.z_dot)
        self._before[:] = self.z
