"""Gravity compensation of any robot that a URDF file describes."""

from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import RobotModel
from pbonet.modules._values import keep


class Robot(Params):
    """The robot."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]


class Gravity(PortBasedObject[Robot], module_class="controller"):
    """t_grav = the torques that hold the robot still where it is.

    Computed by pinocchio from the masses in the robot's URDF file. It has the ports of
    `grav_comp`, which knows an arm by its DH table.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured joint position")]
    t_grav: A[Vector, OutVar("T_GRAV", "ndof", "N*m", "torque that balances gravity")]

    def init(self) -> None:
        self._model = RobotModel(self.params.urdf, self.task.libraries)
        self._model.must_have(self.ndof)

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf"})

    def on(self) -> None:
        self.cycle(0.0)

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - statics
        self.t_grav[:] = self._model.gravity(self.q)
