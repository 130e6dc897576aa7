"""Limits of position, velocity and acceleration of any variable."""

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
from pbonet.modules._values import PerElement, bounds, spread

FREE = 1e12
"""The limit where none is given: more than any robot's, and finite."""


_ROUNDING = 1.0 + 1e-6
"""How far above a limit a velocity still keeps it: it is a difference of values."""


class Bounds(Params):
    """The limits, one for each element or one for all, in the unit of Z."""

    lower: A[PerElement, param("none", "smallest value")] = (-FREE,)
    upper: A[PerElement, param("none", "largest value")] = (FREE,)
    velocity: A[PerElement, param("none", "largest change per s", gt=0)] = (FREE,)
    acceleration: A[PerElement, param("none", "largest change of that per s", gt=0)] = (
        FREE,
    )


class Limits(PortBasedObject[Bounds], module_class="signal"):
    """y follows z as fast as the limits of position, velocity and acceleration allow.

    In a cycle of dt, y moves by v dt with v = v_z + s(d): the velocity of z, and what
    closes the gap d to it. There s(d) is the largest velocity from which cycles of dt
    come to rest within d: a dt (n / 2 + u / (n + 1)) with u = d / (a dt^2) and n the
    largest integer with n (n + 1) / 2 <= u; about sqrt(2 a d).
    Then v is clipped to the velocity limit, to what can rest before LOWER and UPPER
    (soft limits), and to a change of a dt. So a z that keeps the limits is followed
    without a lag; one that does not counts as at rest (v_z = 0). It begins where Y
    stands, at rest. If Y begins beyond a position limit it may come back, but not go
    further. An infinite z is as far as the limits let y go; a NaN ends in ERROR.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z: A[Vector, InVar("Z", "ndof", "any", "the wanted value")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the value within the limits")]

    def init(self) -> None:
        self._take_limits()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_limits()

    def on(self) -> None:
        self._v = np.zeros(self.ndof)
        self._z, self._pace = self._within(self.z), np.zeros(self.ndof)

    def cycle(self, dt: float) -> None:
        y, step = self.y, self._acceleration * dt
        low, high = np.minimum(self._lower, y), np.maximum(self._upper, y)
        z = self._within(self.z)
        pace = self._pace_of(z, dt, step)
        gap = z - y - pace * dt
        v = pace + np.copysign(self._reach(np.abs(gap), dt, step), gap)
        v = clipped(v, -self._velocity, self._velocity)
        v = clipped(v, -self._reach(y - low, dt, step), self._reach(high - y, dt, step))
        v = clipped(v, self._v - step, self._v + step)
        new = clipped(y + v * dt, low, high)
        self._v = (new - y) / dt
        y[:] = new

    def _pace_of(self, z: Vector, dt: float, step: Vector) -> Vector:
        """Return the velocity of z, 0 where z does not keep the limits itself."""
        pace, before = (z - self._z) / dt, self._pace
        self._z, self._pace = z, pace
        steady = np.abs(pace - before) <= step * _ROUNDING
        steady &= np.abs(pace) <= self._velocity * _ROUNDING
        return pace * steady

    def _within(self, z: Vector) -> Vector:
        return clipped(z, self._lower, self._upper)

    @staticmethod
    def _reach(way: Vector, dt: float, step: Vector) -> Vector:
        """Return the largest velocity from which cycles of dt come to rest in `way`."""
        share = way / (step * dt)
        n = np.floor(0.5 * np.sqrt(1.0 + 8.0 * share) - 0.5)
        reach: Vector = step * (0.5 * n + share / (n + 1.0))
        return reach

    def _take_limits(self) -> None:
        k, n = self.params, self.ndof
        self._lower, self._upper = bounds(k.lower, k.upper, n)
        self._velocity = spread(k.velocity, n, "velocity")
        self._acceleration = spread(k.acceleration, n, "acceleration")


def clipped(values: Vector, low: Vector, high: Vector) -> Vector:
    """Return values within limits; np.clip takes several times as long."""
    within: Vector = np.minimum(np.maximum(values, low), high)
    return within
