"""The way from the value that a variable has to the one that a law gives it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pbonet import Vector


class Takeover:
    """Lets a law without a state take over a variable without a step.

    The first value is the one that the variable has. Its distance from what the law
    says there then fades, as 1 - 3 x^2 + 2 x^3 of the share x of the time.

    Args:
        n: Elements of the variable.
    """

    def __init__(self, n: int) -> None:
        self._offset = np.zeros(n)
        self._begins = False
        self._time = 0.0

    def begin(self) -> None:
        """Take the variable's value as it is in the next cycle for the beginning."""
        self._begins, self._time = True, 0.0

    def apply(self, law: Vector, value: Vector, dt: float, fade: float) -> None:
        """Write to `value` what the law says, and what is left of the distance.

        Args:
            law: What the law says.
            value: The variable.
            dt: Seconds since the last cycle.
            fade: Seconds until the law has it alone.
        """
        if self._begins:
            self._begins = False
            np.subtract(value, law, out=self._offset)
            return
        self._time += dt
        if self._time >= fade:
            value[:] = law
            return
        x = self._time / fade
        np.multiply(self._offset, 1.0 - x * x * (3.0 - 2.0 * x), out=value)
        value += law
