"""Geometry of a camera without distortion, and of a sphere in its picture.

The camera's frame has its origin in the centre of projection; x points to the right of
the picture, y down, z forwards. A place in the picture is (u, v) in pixels, from the
outer corner of the first pixel: the centre of that pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from math import pi, sqrt, tan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_ROUNDS = 8
"""Rounds in which a distance is found; each divides the error by 30 or more."""


class Seen(NamedTuple):
    """The picture of a sphere: an ellipse."""

    u: float
    """Of its centre, pixels to the right."""
    v: float
    """Of its centre, pixels downwards."""
    area: float
    """Square pixels."""


class Pinhole:
    """A camera with square pixels, whose axis goes through the centre of its picture.

    Args:
        width: Pixels.
        height: Pixels.
        fovy: Angle of view from the upper to the lower edge, rad.
    """

    def __init__(self, width: int, height: int, fovy: float) -> None:
        self.width, self.height = width, height
        self.focal = 0.5 * height / tan(0.5 * fovy)
        """Distance of the picture from the centre of projection, pixels."""

    def project(self, point: Floats) -> tuple[float, float]:
        """Return where a point (m) is in the picture, pixels."""
        x, y, z = point.tolist()
        scale = self.focal / z
        return 0.5 * self.width + scale * x, 0.5 * self.height + scale * y

    def sphere(self, centre: Floats, radius: float) -> Seen:
        """Return the picture of a sphere (m) that lies before the camera.

        The rays that touch it are a cone about the direction of its centre, and the
        picture cuts this cone in an ellipse. Its centre is further from the picture's
        centre than where the sphere's own centre is seen.
        """
        x, y, z = centre.tolist()
        before = z * z - radius * radius
        scale = self.focal * z / before
        ahead = sqrt(x * x + y * y + before)
        return Seen(
            0.5 * self.width + scale * x,
            0.5 * self.height + scale * y,
            pi * (self.focal * radius) ** 2 * ahead / before**1.5,
        )

    def centre(self, seen: Seen, radius: float) -> Floats:
        """Return where a sphere is (m) whose picture is `seen`: `sphere` backwards.

        With a the ellipse's centre over the focal length, and w = z^2 - r^2: x and y
        are a w / z, so that area / (pi f^2 r^2) = sqrt(1 + |a|^2 w / z^2) / w.
        That is solved for w by repeated substitution.
        """
        a = (seen.u - 0.5 * self.width) / self.focal
        b = (seen.v - 0.5 * self.height) / self.focal
        square = radius * radius
        share = pi * self.focal * self.focal * square / seen.area
        before = share
        for _ in range(_ROUNDS):
            aside = (a * a + b * b) * before / (before + square)
            before = share * sqrt(1.0 + aside)
        z = sqrt(before + square)
        return np.array([a * before / z, b * before / z, z])
