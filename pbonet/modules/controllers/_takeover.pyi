"""The way from the value that a variable has to the one that a law gives it."""

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]

class Takeover:
    """Lets a law without a state take over a variable without a step.

    The first value is the one that the variable has. Its distance from what the law
    says there then fades, as 1 - 3 x^2 + 2 x^3 of the share x of the time.

    Args:
        value: The variable, [n], which `apply` writes.
    """

    def __init__(self, value: Floats) -> None: ...
    def bound(self, low: ArrayLike, high: ArrayLike) -> None:
        """Set the limits of the variable, one for each element; none at first."""

    def begin(self) -> None:
        """Take the variable's value as it is in the next cycle for the beginning."""

    def apply(self, law: Floats, dt: float, fade: float) -> None:
        """Write what the law says and what is left of the distance, within the limits.

        Args:
            law: What the law says, [n].
            dt: Seconds since the last cycle.
            fade: Seconds until the law has it alone.

        Raises:
            ValueError: The law has another size.
        """
