"""Forward kinematics and Jacobian of any robot that a URDF file describes."""

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
from pbonet.io import RobotModel
from pbonet.modules._dh import scale
from pbonet.modules._values import keep


class Hand(Params):
    """The robot, and the frame of it that is asked for."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    frame: A[str, param("none", "link or joint whose frame is the hand")]
    length: A[float, param("m", "counts as much as one radian", gt=0)] = 0.2


class FkJac(PortBasedObject[Hand], module_class="kinematics"):
    """x = pose of FRAME in the base, J = its Jacobian, both at the measured q.

    Computed by pinocchio from the robot's URDF file. The Jacobian is that of the
    frame's origin in the axes of the base, so x_dot = J q_dot. SIGMA, the smallest
    singular value of J with positions counted in LENGTH, is how far the robot is from a
    singularity. It has the ports of `forward_kin`, which knows an arm by its DH table.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured joint position")]
    x: A[Matrix, OutVar("X_MEZ", "3,4", "mixed", "measured pose, [R p], p in m")]
    jacobian: A[
        Matrix, OutVar("J_MEZ", "6,ndof", "mixed", "m/rad in three rows, then rad/rad")
    ]
    sigma: A[float, OutVar("SIGMA", "1", "none", "smallest singular value")]

    def init(self) -> None:
        self._take_robot()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf", "frame"})
        self._take_scale()

    def on(self) -> None:
        self.cycle(0.0)

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self._model.jacobian(self.q, self._frame, self.x, self.jacobian)
        values = np.linalg.svd(self._scale * self.jacobian, compute_uv=False)
        self.sigma = float(values[-1])

    def _take_robot(self) -> None:
        k = self.params
        self._model = RobotModel(k.urdf, self.task.libraries)
        self._model.must_have(self.ndof)
        self._frame = self._model.frame(k.frame)
        self._take_scale()

    def _take_scale(self) -> None:
        self._scale = scale(self.params.length)[:, None]
