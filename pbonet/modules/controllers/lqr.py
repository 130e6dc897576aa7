"""Linear quadratic control of a plant that is given by its matrices."""

from importlib import import_module
from typing import Annotated as A, Any

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import from_extra
from pbonet.modules._ode import propagator
from pbonet.modules._takeover import Takeover
from pbonet.modules._values import PerElement, spread


class Plant(Params):
    """The plant z' = A z + B u, the weights, and the limits of u."""

    a: A[PerElement, param("mixed", "matrix A, row by row")]
    b: A[PerElement, param("mixed", "matrix B, row by row")]
    q: A[PerElement, param("mixed", "weight of each state", ge=0)]
    r: A[PerElement, param("mixed", "weight of each command", gt=0)]
    lower: A[PerElement, param("none", "smallest command, in the unit of U")]
    upper: A[PerElement, param("none", "largest command, in the unit of U")]
    fade: A[float, param("s", "time until U is what the law says", gt=0)] = 0.1


class Lqr(PortBasedObject[Plant], module_class="controller"):
    """u = -K (z - z_ref), with the K that makes the sum of z' Q z + u' R u least.

    K is that of the plant sampled at the task's rate with the command held between two
    cycles (Kalman 1960; Anderson and Moore 1990, section 2.4). It is computed by scipy
    when the task is created, or a parameter is set. Q and R are diagonal. When the
    module is turned on it goes on from the U that is there, and the distance fades.
    """

    z_ref: A[Vector, InVar("Z_REF", "n", "mixed", "reference state")]
    z: A[Vector, InVar("Z_MEZ", "n", "mixed", "measured or estimated state")]
    u: A[Vector, OutVar("U", "m", "any", "command")]

    def init(self) -> None:
        self._takeover = Takeover(len(self.u))
        with from_extra("design", "the gain of a linear quadratic controller"):
            self._linalg: Any = import_module("scipy.linalg")
        self._take_plant()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_plant()

    def on(self) -> None:
        self._takeover.begin()

    def cycle(self, dt: float) -> None:
        law = self._gain @ (self.z_ref - self.z)
        self._takeover.apply(law, self.u, dt, self.params.fade)
        np.clip(self.u, self._lower, self._upper, out=self.u)

    def _take_plant(self) -> None:
        k, n, m = self.params, len(self.z), len(self.u)
        both = np.zeros((n + m, n + m))
        both[:n, :n] = spread(k.a, n * n, "a").reshape(n, n)
        both[:n, n:] = spread(k.b, n * m, "b").reshape(n, m)
        step = propagator(both, 1.0 / self.task.freq)
        a, b = step[:n, :n], step[:n, n:]
        q, r = np.diag(spread(k.q, n, "q")), np.diag(spread(k.r, m, "r"))
        try:
            cost: Matrix = self._linalg.solve_discrete_are(a, b, q, r)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ParameterError(
                "no gain stabilizes this plant",
                expected="A and B that can be stabilized, and a weight on each state "
                "that does not settle by itself",
                got=str(error),
                remedy="check A, B and Q",
            ) from None
        gain = np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a)
        self._gain: Matrix = np.asarray(gain, dtype=np.float64)
        self._lower = spread(k.lower, m, "lower")
        self._upper = spread(k.upper, m, "upper")
