"""A trajectory generator: the hand on a circle."""

from math import cos, pi, sin
from typing import Annotated as A

from pbonet import Matrix, OutVar, Params, PortBasedObject, Vector, param


class Round(Params):
    """The circle."""

    radius: A[float, param("m", "radius", gt=0)]
    freq: A[float, param("Hz", "rounds per second", gt=0)]
    ramp: A[float, param("s", "time until the speed is reached", gt=0)] = 1.0


class Circle(PortBasedObject[Round], module_class="trajectory"):
    """p = p0 + radius (1 - cos a) y - radius sin(a) z, with a growing at 2 pi freq.

    It begins where X_DES stands when the module is turned on, at rest, and lies in the
    vertical plane across the arm; the orientation stays as it is.
    """

    x: A[Matrix, OutVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    v: A[Vector, OutVar("X^_DES", "6", "mixed", "its velocity, m/s and rad/s")]

    def on(self) -> None:
        """Begin where the goal stands."""
        self._start = self.x[:, 3].copy()
        self._time = self._angle = 0.0

    def cycle(self, dt: float) -> None:
        """Go a little farther round."""
        k = self.params
        self._time += dt
        rate = 2.0 * pi * k.freq * min(self._time / k.ramp, 1.0)
        self._angle += rate * dt
        s, c = sin(self._angle), cos(self._angle)
        self.x[1, 3] = self._start[1] + k.radius * (1.0 - c)
        self.x[2, 3] = self._start[2] - k.radius * s
        self.v[1], self.v[2] = k.radius * rate * s, -k.radius * rate * c

    def off(self) -> None:
        """Stand still."""
        if not self.task.handover:
            self.v[:] = 0.0
