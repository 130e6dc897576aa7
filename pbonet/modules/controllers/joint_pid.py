"""Joint-space PID control, one independent loop per joint."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.modules.controllers._approach import Approach


class Gains(Params):
    """Gains shared by every joint."""

    kp: A[float, param("N*m/rad", "stiffness", ge=0)]
    limit: A[float, param("N*m", "largest torque per joint", gt=0)]
    ki: A[float, param("N*m/(rad*s)", "integral gain", ge=0)] = 0.0
    kd: A[float, param("N*m*s/rad", "damping", ge=0)] = 0.0
    speed: A[
        float, param("rad/s", "how fast it begins to go to a Q_REF far away", gt=0)
    ] = 0.5


class JointPID(PortBasedObject[Gains], module_class="controller"):
    """Hold q at q_ref: tau = kp*e + integral(ki*e) - kd*qd, with e = q_ref - q.

    With an integral term the torque begins at what the table holds: what another
    controller commanded last, or nothing at the first start. Turned on without a
    predecessor, it begins with a reference where the arm is, which goes to Q_REF at
    SPEED: the arm may have been moved by hand.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q_ref: A[Vector, InVar("Q_REF", "ndof", "rad", "reference position")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured position")]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    tau: A[Vector, OutVar("T_REF", "ndof", "N*m", "commanded torque, within +-limit")]

    def init(self) -> None:
        self._approach = Approach(self.ndof)

    def on(self) -> None:
        k = self.params
        self._approach.begin(self.task, self.q_ref, self.q)
        self._integral = np.zeros_like(self.q)  # N*m: one limit bounds every term
        if k.ki:  # go on from the torque that the table holds: a swap without a jump
            error = self._approach.of(self.q_ref, k.speed, 0.0) - self.q
            self._integral += self.tau + k.kd * self.qd - k.kp * error

    def cycle(self, dt: float) -> None:
        k, way = self.params, self._approach
        reference = way.of(self.q_ref, k.speed, dt) if way.goes_on else self.q_ref
        error = reference - self.q
        self._integral += k.ki * error * dt
        self._integral.clip(-k.limit, k.limit, out=self._integral)  # anti-windup
        torque = k.kp * error + self._integral - k.kd * self.qd
        torque.clip(-k.limit, k.limit, out=self.tau)
