"""Bases on wheels: what they are commanded to do, and where they have gone."""

from __future__ import annotations

from math import cos, isfinite, sin
from typing import TYPE_CHECKING

import numpy as np

from pbonet.io import is_rotation

if TYPE_CHECKING:
    from pbonet import Matrix, TaskContext, Vector

_SMALL = 1e-4
"""Turn, rad, below which series are more exact than quotients."""

_FLAT = 1e-2
"""The same for derivatives."""


class Command:
    """The commanded velocity of a base, or rest while there is none.

    Args:
        task: Of the module, for warnings.
        sideways: Whether the base can move to the side.
    """

    def __init__(self, task: TaskContext, *, sideways: bool) -> None:
        self._task, self._sideways = task, sideways
        self._warned = ""

    def take(self, v: Vector) -> tuple[float, float, float]:
        """Return m/s forward, m/s to the left, and rad/s; a fault is reported once."""
        x, y, turn = v.tolist()
        fault = ""
        if not isfinite(x + y + turn):
            fault, x, y, turn = "V_DES is not finite: the base stops", 0.0, 0.0, 0.0
        elif y and not self._sideways:
            fault, y = "V_DES asks for a motion to the side, which is left out", 0.0
        if fault and fault != self._warned:
            self._task.warn(fault)
        self._warned = fault
        return x, y, turn


class Odometry:
    """The pose of a base on the plane, from its velocity.

    It is exact while the velocity is constant in the base's own axes: an arc of a
    circle (the exponential of SE(2)). Height and tilt stay what they were.

    Args:
        pose: Where it begins, [R p]; at the origin if that is no pose.

    Attributes:
        pose: The present pose, [R p] in m.
    """

    def __init__(self, pose: Matrix) -> None:
        known = np.isfinite(pose).all() and is_rotation(pose[:, :3])
        self.pose = pose.copy() if known else np.eye(3, 4)

    def move(self, x: float, y: float, turn: float, dt: float) -> Matrix:
        """Go on for dt seconds with m/s forward, m/s to the left, and rad/s."""
        step = motion(x, y, turn, dt)
        self.pose[:, 3] += self.pose[:, :3] @ step[:, 3]
        self.pose[:, :3] = self.pose[:, :3] @ step[:, :3]
        return self.pose


def motion(x: float, y: float, turn: float, dt: float) -> Matrix:
    """Return the pose, [R p], after dt seconds of a constant velocity in its own axes.

    Args:
        x: m/s forward.
        y: m/s to the left.
        turn: rad/s.
        dt: s.
    """
    a = turn * dt
    c, s = cos(a), sin(a)
    if abs(a) < _SMALL:
        along, across = dt * (1.0 - a * a / 6.0), dt * (a / 2.0 - a**3 / 24.0)
    else:
        along, across = s / turn, (1.0 - c) / turn
    return np.array((
        (c, -s, 0.0, along * x - across * y),
        (s, c, 0.0, across * x + along * y),
        (0.0, 0.0, 1.0, 0.0),
    ))


def turn_slope(x: float, y: float, turn: float, dt: float) -> tuple[float, float]:
    """Return the derivative of the way, x and y of `motion`, by its turn."""
    a = turn * dt
    if abs(a) < _FLAT:
        along = dt * dt * (-a / 3.0 + a**3 / 30.0 - a**5 / 840.0)
        across = dt * dt * (0.5 - a * a / 8.0 + a**4 / 144.0 - a**6 / 5760.0)
    else:
        c, s = cos(a), sin(a)
        along = (a * c - s) / (turn * turn)
        across = (a * s - (1.0 - c)) / (turn * turn)
    return along * x - across * y, across * x + along * y


def within(rates: Vector, limit: float) -> Vector:
    """Return wheel rates of the same ratio, none of them above the limit."""
    largest = float(np.abs(rates).max())
    return rates * (limit / largest) if largest > limit else rates


class WheeledBase:
    """A base whose wheel rates are linear in its velocity.

    Args:
        task: Of the module, for warnings.
        sideways: Whether it can move to the side.
    """

    def __init__(self, task: TaskContext, *, sideways: bool) -> None:
        self._command = Command(task, sideways=sideways)

    def take_wheels(self, rows: Matrix, radius: float, limit: float) -> None:
        """Set the wheels.

        Args:
            rows: Speed of each wheel's rim per m/s forward, m/s to the left and rad/s.
            radius: m.
            limit: Largest rate of a wheel, rad/s.
        """
        self._rates, self._limit = rows / radius, limit
        self._motion = np.linalg.pinv(self._rates)

    def begin(self, pose: Matrix) -> None:
        """Begin at this pose, or at the origin, which is then written into it."""
        self._odometry = Odometry(pose)
        pose[:] = self._odometry.pose

    def drive(self, v_des: Vector, w_ref: Vector) -> None:
        """Write the wheel rates for a commanded velocity."""
        w_ref[:] = within(self._rates @ self._command.take(v_des), self._limit)

    def measure(self, w: Vector, dt: float, v: Vector, pose: Matrix) -> None:
        """Write the velocity that measured rates mean, and the new pose."""
        v[:] = self._motion @ w
        x, y, turn = v.tolist()
        pose[:] = self._odometry.move(x, y, turn, dt)
