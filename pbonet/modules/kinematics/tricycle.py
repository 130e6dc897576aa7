"""Kinematics and odometry of a base whose one front wheel steers and drives."""

from math import atan2, copysign, cos, hypot, pi, sin
from typing import Annotated as A

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._wheeled_base import Command, Odometry

SLOW = 1e-6
"""m/s of the front wheel, below which it keeps its angle."""


class Wheel(Params):
    """The front wheel."""

    radius: A[float, param("m", "radius of the front wheel", gt=0)]
    wheelbase: A[float, param("m", "from the rear axle to the front wheel", gt=0)]
    steer: A[float, param("rad", "largest angle", gt=0, le=pi / 2)] = pi / 2
    limit: A[float, param("rad/s", "largest rate of the wheel", gt=0)] = 1e3


class Tricycle(PortBasedObject[Wheel], module_class="kinematics"):
    """tan s = turn wheelbase / v, w = v_front cos(s - s_mez) / radius.

    v is the velocity of the rear axle's middle and v_front that of the front wheel,
    hypot(v, turn wheelbase), backwards where v is. With STEER pi / 2, as it is by
    default, the base also turns where it stands, about that middle. A smaller STEER
    keeps v and lets the path be wider; a turn at rest then only turns the wheel. A rate
    above LIMIT is lowered and the path stays. While the wheel is not yet at its angle
    it drives slower, by the cosine of what is missing, and not at all from 90 degrees
    on. At rest the wheel keeps its angle. The pose of the rear axle's middle follows
    from the measured rate and angle, by arcs of circles, and begins with the pose in
    the table, or at the origin. A command to the side is reported and left out. When
    V_DES is older than 0.5 s or not finite, and in `stable`, the wheel stops and the
    pose goes on; a measurement that is not finite ends in ERROR.
    """

    v_des: A[
        Vector,
        InVar(
            "V_DES",
            "3",
            "mixed",
            "commanded velocity: m/s forward, m/s to the left, rad/s",
            max_age=0.5,
            stale="stable",
        ),
    ]
    w: A[float, InVar("W_MEZ", "1", "rad/s", "measured rate, as W_REF")]
    s: A[float, InVar("S_MEZ", "1", "rad", "measured angle, as S_REF")]
    w_ref: A[float, OutVar("W_REF", "1", "rad/s", "rate of the front wheel")]
    s_ref: A[float, OutVar("S_REF", "1", "rad", "its angle, to the left")]
    x: A[Matrix, OutVar("X_MEZ", "3,4", "mixed", "pose of the base, [R p], p in m")]
    v: A[Vector, OutVar("V_MEZ", "3", "mixed", "measured velocity, as V_DES")]

    def init(self) -> None:
        self._command = Command(self.task, sideways=False)

    def on(self) -> None:
        self._odometry = Odometry(self.x)
        self.x[:] = self._odometry.pose

    def cycle(self, dt: float) -> None:
        k = self.params
        v, _, turn = self._command.take(self.v_des)
        across = turn * k.wheelbase
        side = copysign(across, -across if v < 0.0 else across)
        speed = copysign(hypot(v, across), v) if v else abs(across)
        if abs(speed) > SLOW:
            self.s_ref = min(max(atan2(side, abs(v)), -k.steer), k.steer)
            if abs(self.s_ref) == k.steer < pi / 2:
                speed = v / cos(k.steer)
        speed = speed if abs(speed) > SLOW else 0.0
        rate = speed * max(0.0, cos(self.s_ref - self.s)) / k.radius
        self.w_ref = min(max(rate, -k.limit), k.limit)
        self._measure(dt)

    def stable(self, dt: float) -> None:
        """Stop with the wheel as it stands, and go on measuring."""
        self.w_ref = 0.0
        self._measure(dt)

    def off(self) -> None:
        if not self.task.handover:
            self.w_ref = 0.0

    def _measure(self, dt: float) -> None:
        k = self.params
        rim = k.radius * self.w
        speed, turn = rim * cos(self.s), rim * sin(self.s) / k.wheelbase
        self.v[:] = speed, 0.0, turn
        self.x[:] = self._odometry.move(speed, 0.0, turn, dt)
