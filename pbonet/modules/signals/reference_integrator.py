"""A reference out of a velocity, which waits for what follows it."""

from typing import Annotated as A

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._values import PerElement, bounds, spread


class Lead(Params):
    """Limits of the reference."""

    lower: A[PerElement, param("none", "smallest value, in the unit of Z")]
    upper: A[PerElement, param("none", "largest value, in the unit of Z")]
    lead: A[PerElement, param("none", "how far Z may be from what follows it", gt=0)]


class ReferenceIntegrator(PortBasedObject[Lead], module_class="signal"):
    """z += z_dot * dt, within the limits and not more than LEAD from z_mez.

    While a robot does not follow, because it runs `stable` or something holds it, a
    controller that works on the measured error goes on asking for a velocity. The
    reference then waits at the distance LEAD, so that the robot has no more than that
    to catch up. It goes on from wherever Z stands when the module is turned on. A value
    that begins beyond a limit, or farther away than LEAD, may come back, but not go
    further. `integrator` is the same without something that follows.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z_dot: A[Vector, InVar("Z^", "ndof", "any", "the commanded velocity")]
    z_mez: A[Vector, InVar("Z_MEZ", "ndof", "any", "what follows Z, as measured")]
    z: A[Vector, OutVar("Z", "ndof", "any", "the reference")]

    def init(self) -> None:
        self._take_limits()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_limits()

    def cycle(self, dt: float) -> None:
        z, seen, lead = self.z, self.z_mez, self._lead
        low = np.minimum(np.maximum(self._lower, seen - lead), z)
        high = np.maximum(np.minimum(self._upper, seen + lead), z)
        (z + self.z_dot * dt).clip(low, high, out=z)

    def _take_limits(self) -> None:
        k, n = self.params, self.ndof
        self._lower, self._upper = bounds(k.lower, k.upper, n)
        self._lead = spread(k.lead, n, "lead")
