"""Geometry of a serial arm with revolute joints, from its Denavit-Hartenberg table.

Row i of the table is (theta, d, a, alpha), and frame i stands in frame i-1 at
Rz(theta + q) Tz(d) Tx(a) Rx(alpha), as in `pbonet.io.chain`. A pose is the matrix
[R p] of three rows and four columns: orientation and origin (m) of a frame in the base.
Velocities and small displacements are (m/s, rad/s) and (m, rad) in the base's axes.
"""

from __future__ import annotations

from math import acos, atan2, isfinite, pi, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pbonet import Matrix, Vector

_SMALL = 1e-9


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


def rotation(turn: Vector) -> Matrix:
    """Return the rotation matrix of a turn: axis times angle, rad (Rodrigues)."""
    return rotation_by(*turn.tolist())


def rotation_by(x: float, y: float, z: float) -> Matrix:
    """Return the rotation matrix of a turn of these elements (Rodrigues)."""
    # nine numbers: plain Python is faster here than numpy's calls would be
    square = x * x + y * y + z * z
    if square < _SMALL * _SMALL:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    angle = sqrt(square)
    s, c = sin(angle) / angle, 2.0 * (sin(0.5 * angle) / angle) ** 2
    xy, xz, yz = c * x * y, c * x * z, c * y * z
    return np.array([
        [1.0 - c * (y * y + z * z), xy - s * z, xz + s * y],
        [xy + s * z, 1.0 - c * (x * x + z * z), yz - s * x],
        [xz - s * y, yz + s * x, 1.0 - c * (x * x + y * y)],
    ])


def turn_of(matrix: Matrix) -> Vector:
    """Return the turn, axis times angle (rad, at most pi), of a rotation matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    axis, cosine = (zy - yz, xz - zx, yx - xy), 0.5 * (xx + yy + zz - 1.0)
    factor = _of_sine(axis, cosine)
    return _half_turn(matrix) if factor is None else factor * np.array(axis)


def _of_sine(axis: tuple[float, float, float], cosine: float) -> float | None:
    """Return the factor that makes a turn of its axis times twice its sine.

    None for half a turn, whose axis this does not say.
    """
    x, y, z = axis
    size = sqrt(x * x + y * y + z * z)
    if size > _SMALL:
        return atan2(0.5 * size, cosine) / size
    return 0.5 if cosine > 0.0 else None


def _half_turn(m: Matrix) -> Vector:
    """Return half a turn: its axis is the eigenvector of 1, up to its sign."""
    column = int(np.argmax(np.diag(m)))
    axis = m[:, column] + np.eye(3)[column]
    half: Vector = axis * (pi / sqrt(float(axis @ axis)))
    return half


def difference(wanted: Matrix, pose: Matrix) -> Vector:
    """Return the displacement (m, rad) that takes `pose` to `wanted`, [6]."""
    return np.array(displacement(wanted, pose))


def displacement(wanted: Matrix, pose: Matrix) -> tuple[float, ...]:
    """Return the displacement (m, rad) that takes `pose` to `wanted`, as six numbers.

    Args:
        wanted: A pose; further rows do not count.
        pose: The same.
    """
    # plain Python is faster here than numpy's calls would be
    (a, b, c, x), (d, e, f, y), (g, h, i, z) = wanted[:3].tolist()
    (p, q, r, u), (s, t, k, v), (l, m, n, w) = pose[:3].tolist()  # noqa: E741
    axis = (
        g * s + h * t + i * k - d * l - e * m - f * n,
        a * l + b * m + c * n - g * p - h * q - i * r,
        d * p + e * q + f * r - a * s - b * t - c * k,
    )
    trace = a * p + b * q + c * r + d * s + e * t + f * k + g * l + h * m + i * n
    factor = _of_sine(axis, 0.5 * (trace - 1.0))
    turn = (
        _half_turn(wanted[:3, :3] @ pose[:3, :3].T).tolist()
        if factor is None
        else [factor * one for one in axis]
    )
    return x - u, y - v, z - w, *turn


def gap(wanted: Matrix, pose: Matrix) -> tuple[float, float]:
    """Return the distance between two poses: m, and rad."""
    step = wanted[:, 3] - pose[:, 3]
    cosine = 0.5 * (float(np.trace(wanted[:, :3].T @ pose[:, :3])) - 1.0)
    return sqrt(float(step @ step)), acos(min(1.0, max(-1.0, cosine)))


def is_rotation(matrix: Matrix) -> bool:
    """Return whether a matrix is a rotation, to 1e-6."""
    return _is_rotation(*matrix.ravel().tolist())


def _is_rotation(  # noqa: PLR0917 - nine numbers of a matrix, row by row
    a: float,
    b: float,
    c: float,
    d: float,
    e: float,
    f: float,
    g: float,
    h: float,
    i: float,
) -> bool:
    off = (
        abs(a * a + b * b + c * c - 1.0),
        abs(d * d + e * e + f * f - 1.0),
        abs(g * g + h * h + i * i - 1.0),
        abs(a * d + b * e + c * f),
        abs(a * g + b * h + c * i),
        abs(d * g + e * h + f * i),
    )
    close = max(off) < 1e-6 and isfinite(sum(off))  # noqa: PLR2004
    return close and a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) > 0


def fault_of(pose: Matrix) -> str:
    """Return why a matrix is no pose, as the end of a sentence; empty if it is one."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z) = pose.tolist()
    if not isfinite(a + b + c + d + e + f + g + h + i + x + y + z):
        return "it has elements that are not finite"
    if not _is_rotation(a, b, c, d, e, f, g, h, i):
        return "its orientation is not a rotation"
    return ""


AXES = "x", "y", "z", "the turn about x", "the turn about y", "the turn about z"
"""Names of the six directions of a wrench or a velocity."""


def fault_of_wrench(name: str, wrench: Vector) -> str:
    """Return which element of a wrench is no number; empty if all are.

    Args:
        name: The variable.
        wrench: Its value, [6].
    """
    if isfinite(sum(wrench.tolist())):  # a third of the time of numpy's sum
        return ""
    return f"{name} along {AXES[int(np.argmin(np.isfinite(wrench)))]} is not finite"


def shortened(x: float, y: float, z: float, limit: float) -> tuple[float, float, float]:
    """Return a vector that is shortened to `limit` if it is longer."""
    size = sqrt(x * x + y * y + z * z)
    if size <= limit:
        return x, y, z
    factor = limit / size
    return x * factor, y * factor, z * factor


def shorten(v: Vector, limit: float) -> None:
    """Shorten a vector to `limit` if it is longer, in place."""
    size = sqrt(float(v @ v))
    if size > limit:
        v *= limit / size


def scale(length: float) -> Vector:
    """Return factors that make six rows (m, rad) comparable: `length` (m) is 1 rad."""
    return np.array([1.0 / length] * 3 + [1.0] * 3)
