"""The red thing in a picture: where it is, how large, and whether it is a disc."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DARK = 40
"""Value of red, of 255, up to which a pixel has no colour that could be trusted."""


class Blob(NamedTuple):
    """All red pixels of a picture, taken for one thing."""

    u: float
    """Of the centroid, pixels to the right of the picture's outer left edge."""
    v: float
    """Of the centroid, pixels below its outer upper edge."""
    area: float
    """Number of pixels; 0: there are none, and the other values mean nothing."""
    roundness: float
    """1 for a full disc, and less for anything else of the same area."""
    inside: float
    """1 if it touches no edge of the picture, else 0."""


NOTHING = Blob(0.0, 0.0, 0.0, 0.0, 0.0)


def red_blob(picture: NDArray[np.uint8]) -> Blob:
    """Return centroid, area and roundness of the red pixels.

    A pixel is red if green and blue are both less than half of red. So one at the edge
    of the thing counts if about half of it is red, and what is behind has no colour.

    Args:
        picture: Rows of pixels of red, green and blue.
    """
    red, others = picture[:, :, 0], np.maximum(picture[:, :, 1], picture[:, :, 2])
    mask = (red > _DARK) & (others < red >> 1)
    columns, rows = mask.sum(axis=0), mask.sum(axis=1)
    area = float(columns.sum())
    if not area:
        return NOTHING
    u, wide = _moments(columns)
    v, high = _moments(rows)
    # a disc of area A has a variance of A / (4 pi) along each axis
    roundness = area / (2.0 * pi * (wide + high))
    cut = columns[0] or columns[-1] or rows[0] or rows[-1]
    return Blob(u, v, area, roundness, 0.0 if cut else 1.0)


def _moments(counts: NDArray[np.int64]) -> tuple[float, float]:
    """Return mean and variance of places (pixels) that occur so many times.

    A pixel is not a point, and has a variance of its own: 1/12.
    """
    places = np.arange(len(counts)) + 0.5
    total = counts.sum()
    mean = float(counts @ places / total)
    variance = float(counts @ (places - mean) ** 2 / total)
    return mean, variance + 1.0 / 12.0
