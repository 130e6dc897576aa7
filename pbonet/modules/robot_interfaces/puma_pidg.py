"""The robot interface of a PUMA 560: position control with gravity compensation.

The arm behind it is simulated in real time (`pbonet.io.arm`); a module with these ports
and a real arm's drives in place of `SimulatedArm` would replace it without a change
anywhere else.
"""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InVar,
    Matrix,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.io import PUMA560, SimulatedArm, all_finite
from pbonet.modules._values import PerElement, spread, within

N = PUMA560.ndof
PER_JOINT = ("kp", "kd", "ki", "wind", "speed")


class Gains(Params):
    """The control law's gains, one for each joint or one for all."""

    kp: A[PerElement, param("N*m/rad", "stiffness", ge=0)]
    kd: A[PerElement, param("N*m*s/rad", "damping", ge=0)]
    ki: A[PerElement, param("N*m/(rad*s)", "integral gain", ge=0)] = (0.0,)
    wind: A[PerElement, param("N*m", "largest integral torque", ge=0)] = (20.0,)
    speed: A[PerElement, param("rad/s", "largest reference speed", gt=0)] = (1.5,)
    follow: A[float, param("1/s", "gain with which Q_REF is followed", gt=0)] = 10.0
    slow: A[float, param("rad/s^2", "deceleration of the arm in `stable`", gt=0)] = 4.0


class PumaPidg(PortBasedObject[Gains], module_class="robot interface"):
    """tau = kp*e + integral(ki*e) + kd*(v - qd) + t_grav, with e = r - q.

    The reference r moves with v = qd_ref + follow*(q_ref - r), not faster than `speed`
    and not beyond the joint limits. So the steps of a reference that is written less
    often become a smooth motion, and nothing that is written to Q_REF, however far
    away, makes the arm jump; r starts where the arm is. An input that is not finite
    ends in ERROR, and the drives brake.
    """

    ndof: A[int, OutConst("NDOF", "1", "none", "degrees of freedom")]
    dh: A[Matrix, OutConst("DH", "6,4", "mixed", "rows of theta, d, a, alpha")]
    q_ref: A[Vector, InVar("Q_REF", "6", "rad", "reference joint position")]
    qd_ref: A[Vector, InVar("Q^_REF", "6", "rad/s", "reference joint velocity")]
    t_grav: A[Vector, InVar("T_GRAV", "6", "N*m", "torque that balances gravity")]
    q: A[Vector, OutVar("Q_MEZ", "6", "rad", "measured joint position", new=True)]
    qd: A[Vector, OutVar("Q^_MEZ", "6", "rad/s", "measured joint velocity", new=True)]

    def init(self) -> None:
        self.ndof = N
        self.dh[:] = PUMA560.dh
        self._arm = SimulatedArm(PUMA560)
        self._take_gains()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_gains()

    def on(self) -> None:
        # A simulated arm stands where the table says that it was seen last; that of a
        # real one would be overwritten here by what its encoders say.
        self._arm.place(self.q, self.qd)
        self._start()

    def cycle(self, dt: float) -> None:
        if not all_finite(self.q_ref, self.qd_ref, self.t_grav):
            self._arm.brake()
            self.task.fail("a reference or gravity is not finite; the brakes are on")
            return
        self._sense(dt)
        wish = self.qd_ref + self.params.follow * (self.q_ref - self._r)
        within(wish, *self._speeds, self._v)
        self._servo(dt, self.t_grav)

    def stable(self, dt: float) -> None:
        """Slow down and stop, with the arm's own gravity model and no inputs."""
        self._sense(dt)
        step = self.params.slow * dt
        self._v -= self._v.clip(-step, step)
        self._servo(dt, self._arm.chain.gravity(self.q))

    def off(self) -> None:
        if not self.task.handover:
            self._arm.brake()
            self.qd[:] = 0.0

    def _sense(self, dt: float) -> None:
        """Read the arm; start it again if its drives have braked."""
        self._arm.advance(dt)
        self.q[:] = self._arm.q
        self.qd[:] = self._arm.qd
        if self._arm.braked:
            self.task.warn("the drives braked the arm: no torque command came in time")
            self._start()

    def _servo(self, dt: float, gravity: Vector) -> None:
        """Move r by v, and command the torque that takes the arm there."""
        before = self._r.copy()
        within(before + self._v * dt, PUMA560.lower, PUMA560.upper, self._r)
        np.subtract(self._r, before, out=self._v)
        self._v /= dt  # zero at a joint limit
        error = self._r - self.q
        self._integral += self._ki * error * dt
        within(self._integral, *self._winds, self._integral)
        torque = self._kp * error + self._integral + self._kd * (self._v - self.qd)
        torque += gravity
        self._arm.command(torque)  # which the drives limit to what the arm may bear

    def _start(self) -> None:
        """Release the brakes and hold the arm at its position and velocity."""
        self._r = self._arm.q.copy()
        self._v = self._arm.qd.copy()
        self._integral = np.zeros(N)
        self._arm.release_brakes()
        self._arm.command(self._arm.chain.gravity(self._r))

    def _take_gains(self) -> None:
        k = self.params
        laws = {name: spread(getattr(k, name), N, name) for name in PER_JOINT}
        self._kp, self._kd, self._ki = laws["kp"], laws["kd"], laws["ki"]
        self._winds = -laws["wind"], laws["wind"]
        self._speeds = -laws["speed"], laws["speed"]
