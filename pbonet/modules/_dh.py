"""Geometry of a serial arm with revolute joints, from its Denavit-Hartenberg table.

Row i of the table is (theta, d, a, alpha), and frame i stands in frame i-1 at
Rz(theta + q) Tz(d) Tx(a) Rx(alpha), as in `pbonet.io.chain`. A pose is the matrix
[R p] of three rows and four columns: orientation and origin (m) of a frame in the base.
Velocities and small displacements are (m/s, rad/s) and (m, rad) in the base's axes.
"""

from __future__ import annotations

from math import acos, sqrt
from typing import TYPE_CHECKING

import numpy as np

from pbonet.io import all_finite

if TYPE_CHECKING:
    from pbonet import Matrix, Vector


class Geometry:
    """Pose and Jacobian of the last frame of an arm.

    Args:
        dh: Rows of theta (rad), d (m), a (m), alpha (rad); n of them.
    """

    def __init__(self, dh: Matrix) -> None:
        theta, d, a, alpha = np.asarray(dh, dtype=np.float64).reshape(-1, 4).T
        self.n = len(theta)
        self._theta, self._a = theta.copy(), a.copy()
        self._sin, self._cos = np.sin(alpha), np.cos(alpha)
        self._step = np.zeros((self.n, 4, 4))  # each frame in the one before
        self._step[:, 2, 1], self._step[:, 2, 2] = self._sin, self._cos
        self._step[:, 2, 3], self._step[:, 3, 3] = d, 1.0
        self._frame = np.zeros((self.n + 1, 4, 4))  # each frame in the base
        self._frame[0] = np.eye(4)

    def frames(self, q: Vector) -> Matrix:
        """Return the base and all frames at `q` (rad), [n + 1, 4, 4].

        It is a view of memory that the next call writes again.
        """
        step = self._step
        s, c = np.sin(self._theta + q), np.cos(self._theta + q)
        step[:, 0, 0], step[:, 1, 0] = c, s
        step[:, 0, 1], step[:, 1, 1] = -s * self._cos, c * self._cos
        step[:, 0, 2], step[:, 1, 2] = s * self._sin, -c * self._sin
        step[:, 0, 3], step[:, 1, 3] = self._a * c, self._a * s
        for k in range(self.n):
            np.matmul(self._frame[k], step[k], out=self._frame[k + 1])
        return self._frame

    def pose(self, q: Vector) -> Matrix:
        """Return the pose of the last frame at `q` (rad)."""
        return self.frames(q)[-1, :3].copy()

    def jacobian(self, q: Vector) -> tuple[Matrix, Matrix]:
        """Return pose and geometric Jacobian, [6, n], at `q` (rad).

        Column i is what joint i adds to the last frame's velocity by each rad/s: the
        joint's axis z times the lever, and z itself (Whitney 1972).
        """
        frames = self.frames(q)
        pose = frames[-1, :3].copy()
        z, lever = frames[:-1, :3, 2].T, pose[:, 3:] - frames[:-1, :3, 3].T
        jacobian = np.empty((6, self.n))
        jacobian[0] = z[1] * lever[2] - z[2] * lever[1]
        jacobian[1] = z[2] * lever[0] - z[0] * lever[2]
        jacobian[2] = z[0] * lever[1] - z[1] * lever[0]
        jacobian[3:] = z
        return pose, jacobian


def gap(wanted: Matrix, pose: Matrix) -> tuple[float, float]:
    """Return the distance between two poses: m, and rad."""
    step = wanted[:, 3] - pose[:, 3]
    cosine = 0.5 * (float(np.trace(wanted[:, :3].T @ pose[:, :3])) - 1.0)
    return sqrt(float(step @ step)), acos(min(1.0, max(-1.0, cosine)))


AXES = "x", "y", "z", "the turn about x", "the turn about y", "the turn about z"
"""Names of the six directions of a wrench or a velocity."""


def fault_of_wrench(name: str, wrench: Vector) -> str:
    """Return which element of a wrench is no number; empty if all are.

    Args:
        name: The variable.
        wrench: Its value, [6].
    """
    if all_finite(wrench):
        return ""
    return f"{name} along {AXES[int(np.argmin(np.isfinite(wrench)))]} is not finite"


def shorten(v: Vector, limit: float) -> None:
    """Shorten a vector to `limit` if it is longer, in place."""
    size = sqrt(float(v @ v))
    if size > limit:
        v *= limit / size


def scale(length: float) -> Vector:
    """Return factors that make six rows (m, rad) comparable: `length` (m) is 1 rad."""
    return np.array([1.0 / length] * 3 + [1.0] * 3)
