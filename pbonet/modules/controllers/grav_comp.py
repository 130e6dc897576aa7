"""Gravity compensation of any serial arm with revolute joints."""

from typing import Annotated as A

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.io import Chain
from pbonet.modules._values import PerElement, spread


class Links(Params):
    """Masses of the arm and its load, link by link from the base."""

    mass: A[PerElement, param("kg", "mass of each link", ge=0)]
    com: A[
        PerElement,
        param("m", "centre of mass of each link in its own frame: x y z, link by link"),
    ]
    payload: A[float, param("kg", "mass held at the last frame's origin", ge=0)] = 0.0


class GravComp(PortBasedObject[Links], module_class="controller"):
    """t_grav = the torques that hold the arm still where it is.

    The arm's geometry comes from its robot interface as the constant DH, so the module
    serves every arm; its masses come from the .rmod file.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    dh: A[Matrix, InConst("DH", "ndof,4", "mixed", "rows of theta, d, a, alpha")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured joint position")]
    t_grav: A[Vector, OutVar("T_GRAV", "ndof", "N*m", "torque that balances gravity")]

    def init(self) -> None:
        self._weigh()

    def reinit(self) -> None:
        self._weigh()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._weigh()

    def on(self) -> None:
        self.cycle(0.0)

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - statics
        self.t_grav[:] = self._chain.gravity(self.q)

    def _weigh(self) -> None:
        n, k = self.ndof, self.params
        mass = spread(k.mass, n, "mass")
        com = spread(k.com, 3 * n, "com").reshape(n, 3)
        total = mass[-1] + k.payload
        if k.payload:
            com[-1] *= mass[-1] / total  # the payload's own is at the origin
            mass[-1] = total
        self._chain = Chain(self.dh, mass, com)
