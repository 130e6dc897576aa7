"""Online trajectory generation in joint space: any goal, at any time, by ruckig."""

from math import isfinite
from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    UserSignal,
    Vector,
    param,
)
from pbonet.modules._online_trajectory import OnlineTrajectory
from pbonet.modules._values import PerElement, rest, spread


class Limits(Params):
    """Limits of the motion, one for each joint or one for all."""

    velocity: A[PerElement, param("rad/s", "largest velocity", gt=0)]
    acceleration: A[PerElement, param("rad/s^2", "largest acceleration", gt=0)]
    jerk: A[PerElement, param("rad/s^3", "largest jerk", gt=0)]


class Otg(PortBasedObject[Limits], module_class="trajectory"):
    """q_ref goes to q_des in least time, with limited velocity, acceleration and jerk.

    All joints arrive together (ruckig; Berscheid and Kroeger 2021). The goal may change
    at any time: the motion bends to the new one without a jump in acceleration. It
    begins where Q_REF stands when the module is turned on, at rest, or with the
    derivatives that a predecessor has just written; a velocity above the limit is first
    reduced. When Q_DES is not finite, and in `stable`, it brakes within the limits and
    rests, and goes on when there is a goal again.
    """

    REACHED = UserSignal(0, "Q_REF has arrived at Q_DES")

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q_des: A[Vector, InVar("Q_DES", "ndof", "rad", "goal of the joints")]
    q: A[Vector, OutVar("Q_REF", "ndof", "rad", "reference joint position")]
    q_dot: A[Vector, OutVar("Q^_REF", "ndof", "rad/s", "its velocity")]
    q_acc: A[Vector, OutVar("Q^^_REF", "ndof", "rad/s^2", "its acceleration")]

    def init(self) -> None:
        self._motion = OnlineTrajectory(self.ndof)
        self._take_limits()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_limits()

    def on(self) -> None:
        rest(self.task, self.q_dot, self.q_acc)
        self._motion.start(self.q, self.q_dot, self.q_acc)
        self._goal: list[float] = []
        self._rests = self._warned = False

    def cycle(self, dt: float) -> None:
        goal: list[float] = self.q_des.tolist()
        if goal == self._goal:
            self._step(dt, "goal")
        elif all(map(isfinite, goal)):
            self._goal = goal
            self._motion.aim(goal)
            self._rests = self._warned = False
            self._step(dt, "goal")
        else:
            self._warn_of_goal()
            self.stable(dt)

    def stable(self, dt: float) -> None:
        """Brake, and forget the goal."""
        self._goal = []
        self._motion.brake()
        self._step(dt, "brake")

    def off(self) -> None:
        rest(self.task, self.q_dot, self.q_acc)

    def _step(self, dt: float, towards: str) -> None:
        try:
            ended = self._motion.step(dt)
        except ValueError as error:
            self.task.fail(str(error))
            return
        if ended and not self._rests and towards == "goal":
            self.task.signal(self.REACHED)
            self._rests = True
        self.q[:] = self._motion.position
        self.q_dot[:] = self._motion.velocity
        self.q_acc[:] = self._motion.acceleration

    def _warn_of_goal(self) -> None:
        if not self._warned:
            joints = np.flatnonzero(~np.isfinite(self.q_des)) + 1
            names = ", ".join(map(str, joints))
            self.task.warn(f"Q_DES of joint {names} is not finite: the joints brake")
            self._warned = True

    def _take_limits(self) -> None:
        k, n = self.params, self.ndof
        self._motion.limit(
            spread(k.velocity, n, "velocity"),
            spread(k.acceleration, n, "acceleration"),
            spread(k.jerk, n, "jerk"),
        )
