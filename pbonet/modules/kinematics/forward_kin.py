"""Forward kinematics and Jacobian of any serial arm with revolute joints."""

from typing import Annotated as A

import numpy as np

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
from pbonet.modules._dh import Geometry, scale


class Scale(Params):
    """Weight of positions relative to angles in a single measure."""

    length: A[float, param("m", "counts as much as one radian", gt=0)] = 0.2


class ForwardKin(PortBasedObject[Scale], module_class="kinematics"):
    """x = pose of the last frame, J = its Jacobian, both at the measured q.

    The arm's geometry comes from its robot interface as the constant DH. SIGMA, the
    smallest singular value of J with positions counted in LENGTH, is how far the arm
    is from a singularity: there it is zero, and somewhere the hand cannot be moved.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    dh: A[Matrix, InConst("DH", "ndof,4", "mixed", "rows of theta, d, a, alpha")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured joint position")]
    x: A[Matrix, OutVar("X_MEZ", "3,4", "mixed", "measured pose, [R p], p in m")]
    jacobian: A[
        Matrix, OutVar("J_MEZ", "6,ndof", "mixed", "m/rad in three rows, then rad/rad")
    ]
    sigma: A[float, OutVar("SIGMA", "1", "none", "smallest singular value")]

    def init(self) -> None:
        self._take_arm()

    def reinit(self) -> None:
        self._take_arm()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_arm()

    def on(self) -> None:
        self.cycle(0.0)

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self.x[:], self.jacobian[:] = self._geometry.jacobian(self.q)
        values = np.linalg.svd(self._scale * self.jacobian, compute_uv=False)
        self.sigma = float(values[-1])

    def _take_arm(self) -> None:
        self._geometry = Geometry(self.dh)
        self._scale = scale(self.params.length)[:, None]
