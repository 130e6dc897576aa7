"""Centre of mass and zero moment point of a robot on legs, from its motion."""

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
from pbonet.io import FloatingModel
from pbonet.modules._legs import fault_of_base, fault_of_joints
from pbonet.modules._values import keep

GRAVITY = 9.81
"""m/s^2, as pinocchio has it."""
FLIGHT = 0.1
"""Share of the weight below which the floor carries too little to have a point."""


class Floor(Params):
    """The robot, and the floor on which it stands."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    height: A[float, param("m", "of the floor, in the frame of X_MEZ")] = 0.0
    smooth: A[float, param("s", "time constant of accelerations", ge=0)] = 0.02


class ComZmp(PortBasedObject[Floor], module_class="kinematics"):
    """zmp: where f = dl/dt + m g and n = c x f + dk/dt have no moment along the floor.

    c is the centre of mass, l and k are the momenta of the whole robot, by pinocchio
    from the URDF file and the measured motion; no force is measured. The floor is
    level, at HEIGHT, and z points upwards (Vukobratovic and Borovac 2004). Rates of
    momenta are differences of cycles, smoothed over SMOOTH; with the first cycle there
    are none, so ZMP begins below the centre of mass. While f is less than a tenth of
    the weight, as in a jump, ZMP stays where it was. A measurement that is not finite
    ends in ERROR.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "pose of the base, [R p], p in m")]
    v: A[Vector, InVar("X^_MEZ", "6", "mixed", "its velocity, m/s and rad/s")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured position")]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    com: A[Vector, OutVar("COM", "3", "m", "centre of mass, as p of X_MEZ")]
    com_dot: A[Vector, OutVar("COM^", "3", "m/s", "its velocity")]
    zmp: A[Vector, OutVar("ZMP", "2", "m", "zero moment point, x and y")]

    def init(self) -> None:
        self._model = FloatingModel(self.params.urdf, self.task.libraries)
        self._model.joints.must_have(self.ndof)

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf"})

    def on(self) -> None:
        self._rates: list[float] = [0.0] * 6
        self._before: list[float] = []

    def cycle(self, dt: float) -> None:
        model = self._model
        if not model.move(self.x, self.v, self.q, self.qd):
            self.task.fail(self._fault())
            return
        self.com[:], momenta = model.centroidal()
        # six numbers: plain Python is faster than numpy's calls would be
        now: list[float] = momenta.tolist()
        once, mass = 1.0 / (self.params.smooth + dt), model.mass
        self.com_dot[:] = now[0] / mass, now[1] / mass, now[2] / mass
        if self._before:
            rest, rows = 1.0 - dt * once, (self._rates, now, self._before)
            self._rates = [
                rest * rate + once * (one - was)
                for rate, one, was in zip(*rows, strict=True)
            ]
        self._before = now
        self._find_point()

    def _find_point(self) -> None:
        """Write ZMP from the rates of the momenta."""
        cx, cy, cz = self.com.tolist()
        fx, fy, fz, kx, ky, _ = self._rates
        weight = self._model.mass * GRAVITY
        fz += weight
        if fz < FLIGHT * weight:
            return
        above = cz - self.params.height
        self.zmp[:] = cx - (above * fx + ky) / fz, cy - (above * fy - kx) / fz

    def _fault(self) -> str:
        """Return which measurement is no number."""
        joints = self._model.joints.joints
        return (
            fault_of_base(self.x, self.v)
            or fault_of_joints("Q_MEZ", self.q, joints)
            or fault_of_joints("Q^_MEZ", self.qd, joints)
        )
