"""Unit quaternions (w, x, y, z) in plain floats, which are faster than small arrays."""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pbonet import Matrix

Quaternion = tuple[float, float, float, float]


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the turn q, then p."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def matrix_of(q: Quaternion) -> Matrix:
    """Return the rotation matrix."""
    w, x, y, z = q
    return np.array((
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ))


def quaternion_of(matrix: Matrix) -> Quaternion:
    """Return the quaternion of a rotation matrix, by its largest element (Shepperd)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    rows = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    k = max(range(4), key=lambda n: rows[n][n])
    size = sqrt(sum(part * part for part in rows[k]))
    w, x, y, z = (part / size for part in rows[k])
    return w, x, y, z


def level(x: float, y: float, z: float) -> Quaternion:
    """Return the shortest turn that takes the vector (x, y, z) upwards."""
    size = sqrt(x * x + y * y + z * z)
    x, y, z = x / size, y / size, z / size
    w = sqrt(max(0.5 * (1.0 + z), 0.0))
    if w < 1e-9:  # noqa: PLR2004 - upside down: any half turn about a level axis
        return 0.0, 1.0, 0.0, 0.0
    return w, y / (2.0 * w), -x / (2.0 * w), 0.0
