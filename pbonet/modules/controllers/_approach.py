"""A reference that begins where the robot is, for controllers of joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pbonet.modules._values import within

if TYPE_CHECKING:
    from pbonet import TaskContext, Vector


class Approach:
    """The way from where the robot is measured to its reference, at a limited speed.

    While nothing moves the robot, a person may, and its reference stays. What is left
    of the distance is added to the reference. Only this rest becomes shorter by SPEED,
    so that the way ends, however fast the reference moves meanwhile.

    Args:
        n: Number of joints.

    Attributes:
        goes_on: Whether the robot is still on the way: only then a cycle asks `of`.
    """

    def __init__(self, n: int) -> None:
        self._away, self._near, self._far, self._step = np.zeros((4, n))
        self.goes_on = False

    def begin(self, task: TaskContext, reference: Vector, measured: Vector) -> None:
        """Begin at the robot, unless a predecessor has moved it until now.

        Where `on` runs again after an aborted cycle, the predecessor is the task
        itself, and what was left of its way remains: at most to where the robot is.
        A distance that is no finite number counts as none.

        Args:
            task: The module's own `task`, in `on`.
            reference: The given one, [n].
            measured: Where the robot is, [n].
        """
        distance = measured - reference
        distance[~np.isfinite(distance)] = 0.0
        if task.handover:
            low, high = np.minimum(distance, 0.0), np.maximum(distance, 0.0)
            within(self._away, low, high, self._away)
        else:
            self._away[:] = distance
        self.goes_on = bool(self._away.any())

    def of(self, reference: Vector, speed: Vector | float, dt: float) -> Vector:
        """Return the reference that a cycle goes by.

        Args:
            reference: The given one, [n].
            speed: How fast what is left becomes shorter.
            dt: The seconds of the cycle.
        """
        np.multiply(speed, dt, self._far)
        np.negative(self._far, self._near)
        within(self._away, self._near, self._far, self._step)
        np.subtract(self._away, self._step, self._away)
        self.goes_on = bool(self._away.any())
        return np.add(reference, self._away, self._step)
