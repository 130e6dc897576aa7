"""A path of the hand through timed poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pbonet.errors import ParameterError
from pbonet.io import difference, rotation

from ._dh import gap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet import Matrix, Vector

_CLOSED = 1e-3
"""Largest distance from last to first pose for a path to repeat: m, and rad."""


class PosePath:
    """Straight lines and even turns from pose to pose, at rest in each.

    Between two poses the share s of the way is 10 x^3 - 15 x^4 + 6 x^5 of the share x
    of the time: the least jerk from rest to rest (Flash and Hogan 1985).

    Args:
        time: When the poses are reached, s; 0 first.
        position: x y z of each pose, m, pose by pose.
        angles: Roll pitch yaw of each, rad: turned by Rz(yaw) Ry(pitch) Rx(roll).
        repeat: Whether the path starts again at its end.

    Raises:
        ParameterError: They are no path.
    """

    def __init__(
        self,
        time: Sequence[float],
        position: Sequence[float],
        angles: Sequence[float],
        *,
        repeat: bool,
    ) -> None:
        self._time = np.array(time, dtype=np.float64)
        if (np.diff(self._time) <= 0.0).any() or not len(time) or time[0]:
            raise ParameterError(
                "the times of a path begin at 0 and grow",
                expected="0, then each one later than the one before",
                got=" ".join(f"{t:g}" for t in time) or "nothing",
                remedy="sort the poses by time",
            )
        rows = np.hstack((
            _rows(position, len(time), "position"),
            _rows(angles, len(time), "angles"),
        ))
        self._poses = [pose_of(row) for row in rows]
        self._steps = [
            difference(after, before)
            for before, after in zip(self._poses, self._poses[1:], strict=False)
        ]
        self._repeat = repeat and bool(self._steps)
        metres, radians = gap(self._poses[0], self._poses[-1])
        if repeat and max(metres, radians) > _CLOSED:
            raise ParameterError(
                "the path cannot repeat: its end differs from its start",
                expected="the first pose again as the last",
                got=f"{metres:.3f} m and {radians:.3f} rad away",
                remedy="add the first pose at the end, or use REPEAT no",
            )

    def at(self, time: float) -> tuple[Matrix, Vector]:
        """Return pose, [3, 4], and velocity (m/s, rad/s), [6], at `time` (s)."""
        length = float(self._time[-1])
        time = time % length if self._repeat else min(max(time, 0.0), length)
        part = int(np.searchsorted(self._time, time, side="right")) - 1
        if part >= len(self._steps):
            return self._poses[-1], np.zeros(6)
        lasts = self._time[part + 1] - self._time[part]
        x = (time - self._time[part]) / lasts
        share = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
        speed = 30.0 * x * x * (1.0 - x) ** 2 / lasts
        begin, step = self._poses[part], self._steps[part]
        pose = np.empty((3, 4))
        pose[:, :3] = rotation(share * step[3:]) @ begin[:, :3]
        pose[:, 3] = begin[:, 3] + share * step[:3]
        return pose, speed * step


def _rows(values: Sequence[float], n: int, name: str) -> Matrix:
    """Return the values of parameter `name` as n rows of three."""
    if len(values) != 3 * n:
        raise ParameterError(
            f"parameter {name} has the wrong number of values",
            expected=f"{3 * n}: three for each of the {n} values of TIME",
            got=f"{len(values)} values",
            remedy="give each pose three",
        )
    return np.array(values, dtype=np.float64).reshape(n, 3)


def pose_of(values: Vector) -> Matrix:
    """Return the pose for x y z (m) and roll pitch yaw (rad)."""
    pose = np.empty((3, 4))
    (cr, cp, cy), (sr, sp, sy) = np.cos(values[3:]), np.sin(values[3:])
    pose[:, 0] = cy * cp, sy * cp, -sp
    pose[:, 1] = cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr
    pose[:, 2] = cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr
    pose[:, 3] = values[:3]
    return pose
