"""Linear quadratic control of a plant that is given by its matrices."""

from typing import Annotated as A

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._linear_plant import LinearPlant
from pbonet.modules._values import PerElement, spread
from pbonet.modules.controllers._takeover import Takeover


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
        self._takeover = Takeover(self.u)
        self._take_plant()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_plant()

    def on(self) -> None:
        self._takeover.begin()

    def cycle(self, dt: float) -> None:
        law = self._gain @ (self.z_ref - self.z)
        self._takeover.apply(law, dt, self.params.fade)

    def _take_plant(self) -> None:
        k, n, m = self.params, len(self.z), len(self.u)
        plant = LinearPlant(
            a=k.a, b=k.b, q=k.q, r=k.r, n=n, m=m, dt=1.0 / self.task.freq
        )
        self._gain: Matrix = plant.gain
        lower, upper = spread(k.lower, m, "lower"), spread(k.upper, m, "upper")
        self._takeover.bound(lower, upper)
