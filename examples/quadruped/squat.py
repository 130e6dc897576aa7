"""A trajectory of a legged robot that stands: its body goes down and up once."""

from math import cos, pi, sin
from typing import Annotated as A

from pbonet import Matrix, OutVar, Params, PortBasedObject, Vector, param


class Way(Params):
    """How deep, and when."""

    depth: A[float, param("m", "how far the body goes down", ge=0)]
    begin: A[float, param("s", "when it begins, after `on`", ge=0)] = 1.0
    last: A[float, param("s", "time down and up again", gt=0)] = 2.0


class Squat(PortBasedObject[Way], module_class="trajectory"):
    """z = z0 - depth (1 - cos a) / 2, with a from 0 to 2 pi in the time LAST.

    The body begins where X_BODY_DES stands when the module is turned on, and stays
    there otherwise; the feet stand where X_FEET_DES says.
    """

    x: A[Matrix, OutVar("X_BODY_DES", "3,4", "mixed", "desired pose of the body")]
    v: A[Vector, OutVar("X^_BODY_DES", "6", "mixed", "its velocity, m/s and rad/s")]
    feet: A[Matrix, OutVar("X_FEET_DES", "nfeet,3", "m", "places of the feet")]
    contact: A[Vector, OutVar("CONTACT_DES", "nfeet", "none", "1 for a standing foot")]

    def on(self) -> None:
        """Begin where the body is to be."""
        self._height = float(self.x[2, 3])
        self._time = 0.0
        self.contact[:] = 1.0

    def cycle(self, dt: float) -> None:
        """Go on with the squat."""
        k = self.params
        self._time += dt
        rate = 2.0 * pi / k.last
        angle = rate * min(max(self._time - k.begin, 0.0), k.last)
        self.x[2, 3] = self._height - 0.5 * k.depth * (1.0 - cos(angle))
        self.v[2] = -0.5 * k.depth * rate * sin(angle)

    def off(self) -> None:
        """Stand still."""
        if not self.task.handover:
            self.v[:] = 0.0
