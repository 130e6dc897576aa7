"""A point that is seen now and then, late, and is taken to move evenly meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pbonet import Vector


class TrackedPoint:
    """Place and velocity of a point, by a filter of second order.

    Each measurement corrects place and velocity by shares of how far the point is from
    where it was expected: 1 - s^2 and (1 - s)^2 per time since the last one. So errors
    of the past fade by s with each one, without overshoot.
    """

    def __init__(self) -> None:
        self._place: Vector = np.zeros(3)
        self.velocity: Vector = np.zeros(3)
        self._time: float | None = None

    @property
    def known(self) -> bool:
        """Whether there was a measurement since `forget`."""
        return self._time is not None

    def forget(self) -> None:
        """Begin with the next measurement, as if there had been none."""
        self._time = None

    def correct(self, place: Vector, time: float, smooth: float) -> None:
        """Take a look into account.

        Args:
            place: Where the point was, m.
            time: When it was there, s; after the look before.
            smooth: The share s of the past, from 0 to below 1.
        """
        if self._time is None:
            self._place[:], self.velocity[:] = place, 0.0
        else:
            passed = time - self._time
            self._place += passed * self.velocity
            off = place - self._place
            self._place += (1.0 - smooth * smooth) * off
            self.velocity += (1.0 - smooth) ** 2 / passed * off
        self._time = time

    def at(self, time: float) -> Vector:
        """Return where the point is expected at a time (s), m."""
        if self._time is None:
            return self._place
        return self._place + (time - self._time) * self.velocity
