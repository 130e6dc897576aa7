"""Closed-form inverse kinematics of arms built like the PUMA 560.

Such an arm has its second and third axis parallel, an elbow offset, and three wrist
axes that meet in one point. The steps are those of Paul, Shimano and Mayer 1981
("Kinematic control equations for simple manipulators", IEEE Trans. SMC-11), worked out
again for the signs of the table in `pbonet.io.puma560`: the wrist's point gives the
first three joints, two shoulders and two elbows; the orientation that is left gives the
wrist, two ways more.
"""

from __future__ import annotations

from math import acos, atan2, hypot, pi, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pbonet.errors import ParameterError

from ._dh import Geometry

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet import Matrix, Vector

TURN = 2.0 * pi
_TWISTS = np.array([pi / 2, 0.0, -pi / 2, pi / 2, -pi / 2, 0.0])
_ALIGNED = 1e-9
"""Sine of joint 5 below which joints 4 and 6 turn about one axis."""


class Solution(NamedTuple):
    """The result of inverse kinematics."""

    q: Vector | None
    """Joint angles, rad; None if there is no solution."""
    why: str = ""
    """The reason why there is no solution."""


class PumaArm:
    """Inverse kinematics: the joint angles for a pose of the last frame.

    Args:
        dh: Rows of theta (rad), d (m), a (m), alpha (rad), as the arm publishes them.
        lower: Smallest joint angles, rad, [6].
        upper: Largest joint angles, rad, [6].

    Raises:
        ParameterError: The table is of another kind of arm.
    """

    def __init__(self, dh: Matrix, lower: Vector, upper: Vector) -> None:
        theta, d, a = _checked(dh)
        self._lower, self._upper = lower, upper
        self._offset = theta
        self._d1, self._shift, self._d6 = d[0], d[1] + d[2], d[5]
        self._a2, self._a3, self._d4 = a[1], a[2], d[3]
        self._forearm = hypot(self._a3, self._d4)
        self._bend = atan2(self._d4, self._a3)  # of the elbow offset
        self._geometry = Geometry(dh)

    @property
    def reach(self) -> float:
        """Reach of the wrist point from the shoulder's axes, m."""
        return hypot(abs(self._a2) + self._forearm, self._shift)

    def solve(self, pose: Matrix, near: Vector) -> Solution:
        """Return the joint angles within the limits that are nearest to `near` (rad).

        Args:
            pose: Wanted of the last frame, [3, 4].
            near: Where the arm is, rad, [6]; also what joint 4 keeps where joints 4
                and 6 turn about one axis.
        """
        found = list(self._arms(pose))
        if not found:
            far = float(np.linalg.norm(self._wrist(pose)))
            return Solution(
                None,
                f"out of reach: the wrist would be {far:.3f} m from the shoulder, where"
                f" the arm reaches {self.reach:.3f} m",
            )
        best, least = None, np.inf
        for arm in found:
            for wrist in self._wrists(pose, arm, near):
                q = self._within(np.array([*arm, *wrist]) - self._offset, near)
                if q is not None and (size := np.abs(q - near).max()) < least:
                    best, least = q, size
        if best is None:
            return Solution(None, "only postures beyond the joint limits reach it")
        return Solution(best)

    def singular(self, q: Vector) -> dict[str, float]:
        """Return how far the arm is from each of its singularities at `q` (rad).

        The determinant of the Jacobian is, up to a constant, the product of the three:
        `wrist`, the sine of the angle between the axes 4 and 6; `elbow`, that between
        upper arm and forearm; `shoulder`, the distance of the wrist's point from the
        plane through axis 1, as a share of the reach.
        """
        _, q2, q3, _, q5, _ = q + self._offset
        c23, s23 = np.cos(q2 + q3), np.sin(q2 + q3)
        out = self._a2 * np.cos(q2) + self._a3 * c23 - self._d4 * s23
        return {
            "wrist": abs(float(np.sin(q5))),
            "elbow": abs(float(np.sin(q3 + self._bend))),
            "shoulder": abs(float(out)) / self.reach,
        }

    def _wrist(self, pose: Matrix) -> Vector:
        """Return the wrist's centre relative to the shoulder, m."""
        point: Vector = pose[:, 3] - self._d6 * pose[:, 2]
        point[2] -= self._d1
        return point

    def _arms(self, pose: Matrix) -> Iterator[tuple[float, float, float]]:
        """Yield joints 1 to 3, offsets included, of each shoulder and elbow."""
        x, y, z = self._wrist(pose)
        square = x * x + y * y - self._shift**2
        if square < 0.0:
            return
        for out in (sqrt(square), -sqrt(square)):
            q1 = atan2(y, x) - atan2(-self._shift, out)
            legs = self._a2**2 + self._forearm**2
            cosine = (out * out + z * z - legs) / (2.0 * self._a2 * self._forearm)
            if abs(cosine) > 1.0:
                continue
            for angle in (acos(cosine), -acos(cosine)):
                q3 = angle - self._bend
                along = self._a2 + self._forearm * np.cos(angle)
                across = self._forearm * np.sin(angle)
                yield q1, atan2(z, out) - atan2(across, along), q3

    def _wrists(
        self, pose: Matrix, arm: tuple[float, float, float], near: Vector
    ) -> Iterator[tuple[float, float, float]]:
        """Yield joints 4 to 6, offsets included, for both wrist configurations."""
        posture = np.zeros(6)
        posture[:3] = arm
        forearm = self._geometry.frames(posture - self._offset)[3, :3, :3]
        rest = forearm.T @ pose[:, :3]
        if hypot(rest[0, 2], rest[1, 2]) < _ALIGNED:
            first = float(near[3] + self._offset[3])
        else:
            first = atan2(-rest[1, 2], -rest[0, 2])
        for q4 in (first, first + pi):
            c, s = np.cos(q4), np.sin(q4)
            x = c * rest[0] + s * rest[1]  # rows of what is left behind joint 4
            y, z = rest[2], s * rest[0] - c * rest[1]
            yield q4, atan2(-x[2], y[2]), atan2(-z[0], -z[1])

    def _within(self, q: Vector, near: Vector) -> Vector | None:
        """Return q plus the full turns that bring it closest, within the limits."""
        q = q - TURN * np.round((q - near) / TURN)
        q += TURN * (q < self._lower) - TURN * (q > self._upper)
        fits = np.all((q >= self._lower) & (q <= self._upper))
        return q if fits else None


def _checked(dh: Matrix) -> Matrix:
    """Return the columns theta, d and a if the arm is built like the PUMA."""
    theta, d, a, alpha = np.asarray(dh, dtype=np.float64).reshape(-1, 4).T
    expected = "six joints, twists 90 0 -90 90 -90 0 degrees, a1 a4 a5 a6 d5 zero"
    if len(alpha) != len(_TWISTS):
        raise _other(expected, f"{len(alpha)} joints")
    turned = np.abs(np.remainder(alpha - _TWISTS + pi, TURN) - pi) > 1e-6  # noqa: PLR2004
    if turned.any():
        raise _other(expected, f"twists {np.round(np.degrees(alpha), 3)} degrees")
    if np.any(np.abs([a[0], *a[3:], d[4]]) > _ALIGNED) or not a[1] or not d[3]:
        raise _other(expected, f"a {a}, d {d} m")
    return np.array([theta, d, a])


def _other(expected: str, got: str) -> ParameterError:
    return ParameterError(
        "the constant DH is that of an arm with another wrist or shoulder",
        expected=expected,
        got=got,
        remedy="use damped_ls, which supports any arm",
    )
