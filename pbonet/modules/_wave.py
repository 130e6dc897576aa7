"""The motion of a simulated sensor: a mean value and a sine."""

from __future__ import annotations

from math import pi, sin
from typing import TYPE_CHECKING

from ._values import spread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet import Vector


class Wave:
    """y = mean + amplitude * sin(2 pi t / period).

    Args:
        mean: One for each element, or one for all.
        amplitude: The same.
        period: Seconds.
        n: How many elements there are.
    """

    def __init__(
        self, mean: Sequence[float], amplitude: Sequence[float], period: float, n: int
    ) -> None:
        self._mean = spread(mean, n, "mean")
        self._amplitude = spread(amplitude, n, "amplitude")
        self._rate, self._angle = 2.0 * pi / period, 0.0

    def after(self, dt: float) -> Vector:
        """Return the value after another `dt` seconds."""
        self._angle = (self._angle + self._rate * dt) % (2.0 * pi)
        return self._mean + self._amplitude * sin(self._angle)
