"""A reference that begins where the robot is, for controllers of joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pbonet import TaskContext, Vector


class Approach:
    """The way from where the robot is measured to its reference, at a limited speed.

    While nothing moves the robot, a person may, and its reference stays. What is left
    of the distance is added to the reference, so that this may move meanwhile.

    Args:
        n: Number of joints.
    """

    def __init__(self, n: int) -> None:
        self._away, self._nearer = np.zeros((2, n))
        self._is_there = True

    def begin(self, task: TaskContext, reference: Vector, measured: Vector) -> None:
        """Begin at the robot, unless a predecessor has moved it until now.

        Args:
            task: The module's own `task`, in `on`.
            reference: The given one, [n].
            measured: Where the robot is, [n].
        """
        self._is_there = task.handover
        np.subtract(measured, reference, out=self._away)

    def of(self, reference: Vector, most: Vector | float) -> Vector:
        """Return the reference that a cycle goes by.

        Args:
            reference: The given one, [n].
            most: How much nearer it comes to that in this cycle.
        """
        if self._is_there:
            return reference
        self._away -= self._away.clip(-most, most)
        self._is_there = not self._away.any()
        return np.add(reference, self._away, out=self._nearer)
