"""Online trajectory generation of a pose: any goal, at any time, by ruckig."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    UserSignal,
    Vector,
    param,
)
from pbonet.io import is_rotation
from pbonet.modules._moving_orientation import Turning
from pbonet.modules._online_trajectory import OnlineTrajectory
from pbonet.modules._values import rest


class Limits(Params):
    """Limits of the motion: along each axis, and about each."""

    velocity: A[float, param("m/s", "largest velocity along an axis", gt=0)]
    acceleration: A[float, param("m/s^2", "largest acceleration", gt=0)]
    jerk: A[float, param("m/s^3", "largest jerk", gt=0)]
    turn: A[float, param("rad/s", "largest velocity about an axis", gt=0)]
    turn_acceleration: A[float, param("rad/s^2", "its acceleration", gt=0)]
    turn_jerk: A[float, param("rad/s^3", "its jerk", gt=0)]


class OtgCart(PortBasedObject[Limits], module_class="trajectory"):
    """x_ref goes to x_des in least time, with limited velocity, acceleration and jerk.

    Six axes are moved by ruckig (Berscheid and Kroeger 2021) and arrive together: the
    position, and the rotation vector r from the orientation R0 in which the last goal
    was given; the orientation is exp(r) R0. The limits hold for each axis of the base,
    for a turn as long as the goal stays. Velocity and acceleration of the turn follow
    exactly from r (left Jacobian of SO(3)), so that a new goal causes no jump in them.
    The motion begins in the pose X_REF that is in the table when the module is turned
    on, at rest, or with the velocity of a predecessor. While X_DES is no pose, and in
    `stable`, it brakes and rests.
    """

    REACHED = UserSignal(0, "X_REF has arrived at X_DES")

    x_des: A[Matrix, InVar("X_DES", "3,4", "mixed", "goal, [R p], p in m")]
    x: A[Matrix, OutVar("X_REF", "3,4", "mixed", "reference pose, [R p], p in m")]
    v: A[Vector, OutVar("X^_REF", "6", "mixed", "its velocity, m/s and rad/s")]

    def init(self) -> None:
        self._motion = OnlineTrajectory(6)
        self._take_limits()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_limits()

    def on(self) -> None:
        rest(self.task, self.v)
        if not (np.isfinite(self.x).all() and is_rotation(self.x[:, :3])):
            self.task.fail(
                "X_REF is no pose [R p] to start from; give it one by INIT in the "
                ".svar file, or turn on another writer of X_REF first"
            )
        self._goal = np.full((3, 4), np.nan)
        self._rests = self._warned = False
        self._at, self._speed = self.x[:, 3].copy(), self.v[:3].copy()
        self._turning = Turning(self.x[:, :3], self.v[3:])
        self._push = np.zeros(3)
        self._begin()

    def cycle(self, dt: float) -> None:
        if (self.x_des == self._goal).all():
            self._step(dt, "goal")
        elif np.isfinite(self.x_des).all() and is_rotation(self.x_des[:, :3]):
            self._goal[:] = self.x_des
            self._begin()
            turn = self._turning.to(self._goal[:, :3])
            self._motion.aim(np.concatenate((self._goal[:, 3], turn)).tolist())
            self._rests = self._warned = False
            self._step(dt, "goal")
        else:
            if not self._warned:
                self.task.warn("X_DES is no pose [R p]: the hand brakes")
                self._warned = True
            self.stable(dt)

    def stable(self, dt: float) -> None:
        """Brake, and forget the goal."""
        self._goal[:] = np.nan
        self._motion.brake()
        self._step(dt, "brake")

    def off(self) -> None:
        rest(self.task, self.v)

    def _begin(self) -> None:
        """Count the turn from the present orientation, with its present motion."""
        t = self._turning
        t.rebase()
        self._motion.start(
            np.concatenate((self._at, t.r)),
            np.concatenate((self._speed, t.rate)),
            np.concatenate((self._push, t.push)),
        )

    def _step(self, dt: float, towards: str) -> None:
        try:
            ended = self._motion.step(dt)
        except ValueError as error:
            self.task.fail(str(error))
            return
        if ended and not self._rests and towards == "goal":
            self.task.signal(self.REACHED)
            self._rests = True
        p, v, a = (
            np.array(one)
            for one in (
                self._motion.position,
                self._motion.velocity,
                self._motion.acceleration,
            )
        )
        self._at, self._speed, self._push = p[:3], v[:3], a[:3]
        self._turning.move(p[3:], v[3:], a[3:])
        self.x[:, :3], self.x[:, 3] = self._turning.matrix, p[:3]
        self.v[:3], self.v[3:] = v[:3], self._turning.velocity

    def _take_limits(self) -> None:
        k = self.params
        self._motion.limit(
            np.repeat((k.velocity, k.turn), 3),
            np.repeat((k.acceleration, k.turn_acceleration), 3),
            np.repeat((k.jerk, k.turn_jerk), 3),
        )
