"""An orientation that moves as a rotation vector says."""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from pbonet.io import rotation, turn_of

if TYPE_CHECKING:
    from pbonet import Matrix, Vector

_SMALL = 0.1
"""Angle, rad, below which series are more exact than quotients."""


class Turning:
    """The orientation exp(r) R0, its angular velocity and its angular acceleration.

    With w the angular velocity, B = (1 - cos a) / a^2, C = (a - sin a) / a^3, a = |r|
    and x the cross product: w = r' + B r x r' + C r x (r x r'), the left Jacobian of
    SO(3) (Barfoot 2017, section 7.1.5). The acceleration is the derivative of that.

    Args:
        matrix: The orientation.
        velocity: Its angular velocity in the base's axes, rad/s.

    Attributes:
        matrix: The present orientation.
        velocity: Its angular velocity, rad/s.
        r: The rotation vector from R0, rad; `rate` and `push` are its derivatives.
    """

    def __init__(self, matrix: Matrix, velocity: Vector) -> None:
        self.matrix, self.velocity = matrix.copy(), velocity.copy()
        self._base = self.matrix
        self.r, self.rate, self.push = np.zeros(3), self.velocity, np.zeros(3)

    def rebase(self) -> None:
        """Count r from the present orientation: r is 0 and r' the angular velocity."""
        self.push = self.acceleration()
        self._base, self.r, self.rate = self.matrix, np.zeros(3), self.velocity

    def to(self, matrix: Matrix) -> Vector:
        """Return the rotation vector from R0 to another orientation."""
        return turn_of(matrix @ self._base.T)

    def move(self, r: Vector, rate: Vector, push: Vector) -> None:
        """Go to this rotation vector, with its first and second derivative."""
        self.r, self.rate, self.push = r, rate, push
        b, c, _, _ = _series(sqrt(float(r @ r)))
        once = _cross(r, rate)
        self.velocity = rate + b * once + c * _cross(r, once)
        self.matrix = rotation(r) @ self._base

    def acceleration(self) -> Vector:
        """Return the angular acceleration, rad/s^2."""
        r, rate, push = self.r, self.rate, self.push
        b, c, db, dc = _series(sqrt(float(r @ r)))
        grows = float(r @ rate)
        once, twice = _cross(r, rate), _cross(r, push)
        return (
            push
            + (db * grows) * once
            + b * twice
            + (dc * grows) * _cross(r, once)
            + c * (_cross(rate, once) + _cross(r, twice))
        )


def _cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product; np.cross takes ten times as long."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array((y * w - z * v, z * u - x * w, x * v - y * u))


def _series(angle: float) -> tuple[float, float, float, float]:
    """Return B, C and their derivatives by the angle, divided by the angle."""
    q = angle * angle
    if angle < _SMALL:
        return (
            1 / 2 - q / 24 + q * q / 720 - q**3 / 40320,
            1 / 6 - q / 120 + q * q / 5040 - q**3 / 362880,
            -1 / 12 + q / 180 - q * q / 6720 + q**3 / 453600,
            -1 / 60 + q / 1260 - q * q / 60480 + q**3 / 4989600,
        )
    s, c = sin(angle), cos(angle)
    return (
        (1.0 - c) / q,
        (angle - s) / (q * angle),
        (angle * s - 2.0 * (1.0 - c)) / (q * q),
        (3.0 * s - angle * (2.0 + c)) / (q * q * angle),
    )
