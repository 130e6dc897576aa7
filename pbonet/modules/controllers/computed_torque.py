"""Computed torque control of any robot that a URDF file describes."""

from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import RobotModel
from pbonet.modules._values import PerElement, keep, spread
from pbonet.modules.controllers._approach import Approach
from pbonet.modules.controllers._takeover import Takeover


class Gains(Params):
    """The robot, and how its joints are drawn to the reference."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    kp: A[PerElement, param("1/s^2", "acceleration for each rad of error", ge=0)]
    kd: A[PerElement, param("1/s", "acceleration for each rad/s of error", ge=0)]
    speed: A[
        PerElement, param("rad/s", "how fast it begins to go to a Q_REF far away", gt=0)
    ] = (0.5,)
    fade: A[float, param("s", "time until T_REF is what the law says", gt=0)] = 0.1


class ComputedTorque(PortBasedObject[Gains], module_class="controller"):
    """tau = M a + h + d qd, with a = qdd_ref + kd (qd_ref - qd) + kp (q_ref - q).

    Each joint so behaves as if it were alone and of unit inertia (Luh, Walker and Paul
    1980; An, Atkeson and Hollerbach 1988). The mass matrix M(q), the torques h(q, qd)
    of gravity and velocity, and the viscous friction d are those of the URDF file, by
    pinocchio's recursive Newton-Euler algorithm; kd = 2 sqrt(kp) is critical damping.
    T_REF stays within the efforts that the file gives the joints. When the module is
    turned on it goes on from the T_REF that is there, and the distance fades. Without
    a predecessor the reference begins where the arm is, and goes to Q_REF at SPEED: the
    arm may have been moved by hand.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q_ref: A[Vector, InVar("Q_REF", "ndof", "rad", "reference position")]
    qd_ref: A[Vector, InVar("Q^_REF", "ndof", "rad/s", "reference velocity")]
    qdd_ref: A[Vector, InVar("Q^^_REF", "ndof", "rad/s^2", "reference acceleration")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured position")]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    tau: A[Vector, OutVar("T_REF", "ndof", "N*m", "commanded torque")]

    def init(self) -> None:
        self._takeover = Takeover(self.tau)
        self._approach = Approach(self.ndof)
        self._model = RobotModel(self.params.urdf, self.task.libraries)
        self._model.must_have(self.ndof)
        self._takeover.bound(-self._model.effort, self._model.effort)
        self._take_gains()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf"})
        self._take_gains()

    def on(self) -> None:
        self._takeover.begin()
        self._approach.begin(self.task, self.q_ref, self.q)

    def cycle(self, dt: float) -> None:
        way = self._approach
        reference = way.of(self.q_ref, self._speed, dt) if way.goes_on else self.q_ref
        wish = reference - self.q
        wish *= self._kp
        pull = self.qd_ref - self.qd
        pull *= self._kd
        wish += pull
        wish += self.qdd_ref
        law = self._model.torque(self.q, self.qd, wish)
        self._takeover.apply(law, dt, self.params.fade)

    def _take_gains(self) -> None:
        k, n = self.params, self.ndof
        self._kp, self._kd = spread(k.kp, n, "kp"), spread(k.kd, n, "kd")
        self._speed = spread(k.speed, n, "speed")
