"""Kinematics and odometry of a base that is steered like a car."""

from math import atan, tan
from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.modules._wheeled_base import Command, Odometry, within

SLOW = 1e-6
"""Speed, m/s, below which a car keeps its wheels, because it cannot turn at rest."""


class Car(Params):
    """The wheels."""

    radius: A[float, param("m", "radius of the rear wheels", gt=0)]
    wheelbase: A[float, param("m", "distance between the axles", gt=0)]
    track: A[float, param("m", "distance between left and right wheels", gt=0)]
    steer: A[float, param("rad", "largest angle of the middle", gt=0, lt=1.5)] = 0.6
    limit: A[float, param("rad/s", "largest rate of a wheel", gt=0)] = 1e3


class Ackermann(PortBasedObject[Car], module_class="kinematics"):
    """w = v (1 -+ c track / 2) / radius, tan s = c wheelbase / (1 -+ c track / 2).

    c = turn / v is the curvature of the path of the rear axle's middle, for the left
    and the right side: the axes of all wheels meet in one point. The angle of the
    middle, atan(c wheelbase), is limited by STEER; a rate above LIMIT scales both, and
    the curvature stays. At rest the wheels keep their angle, because a car cannot
    turn where it stands. The pose of the rear axle's middle follows from the measured
    rates and angles, by arcs of circles, and begins with the pose in the table, or at
    the origin. A command to the side is reported and left out. When V_DES is older than
    0.5 s or not finite, and in `stable`, the wheels stop and the pose goes on; a
    measurement that is not finite ends in ERROR.
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
    w: A[Vector, InVar("W_MEZ", "2", "rad/s", "measured rates, as W_REF")]
    s: A[Vector, InVar("S_MEZ", "2", "rad", "measured angles, as S_REF")]
    w_ref: A[Vector, OutVar("W_REF", "2", "rad/s", "rates of the rear wheels: l, r")]
    s_ref: A[Vector, OutVar("S_REF", "2", "rad", "angles of the front wheels: l, r")]
    x: A[Matrix, OutVar("X_MEZ", "3,4", "mixed", "pose of the base, [R p], p in m")]
    v: A[Vector, OutVar("V_MEZ", "3", "mixed", "measured velocity, as V_DES")]

    def init(self) -> None:
        self._command = Command(self.task, sideways=False)
        self._side = np.array([-1.0, 1.0])  # left, right
        self._check()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._check()

    def on(self) -> None:
        self._odometry = Odometry(self.x)
        self.x[:] = self._odometry.pose
        self._curve = self._curvature(self.s_ref)

    def cycle(self, dt: float) -> None:
        k = self.params
        speed, _, turn = self._command.take(self.v_des)
        if abs(speed) > SLOW:
            most = tan(k.steer) / k.wheelbase
            self._curve = min(max(turn / speed, -most), most)
        sides = 1.0 + self._side * (self._curve * k.track / 2.0)
        self.w_ref[:] = within(speed * sides / k.radius, k.limit)
        left, right = (self._curve * k.wheelbase / sides).tolist()
        self.s_ref[:] = atan(left), atan(right)
        self._measure(dt)

    def stable(self, dt: float) -> None:
        """Stop with the wheels as they stand, and go on measuring."""
        self.w_ref[:] = 0.0
        self._measure(dt)

    def off(self) -> None:
        if not self.task.handover:
            self.w_ref[:] = 0.0

    def _check(self) -> None:
        k = self.params
        if tan(k.steer) * k.track / 2.0 >= k.wheelbase:
            most = atan(2.0 * k.wheelbase / k.track)
            raise ParameterError(
                "the car would turn about a point between its wheels",
                expected=f"STEER below {most:.3g} rad",
                got=f"{k.steer:g} rad",
                remedy="lower STEER",
            )

    def _measure(self, dt: float) -> None:
        speed = self.params.radius * float(self.w.mean())
        turn = speed * self._curvature(self.s)
        self.v[:] = speed, 0.0, turn
        self.x[:] = self._odometry.move(speed, 0.0, turn, dt)

    def _curvature(self, angles: Vector) -> float:
        """Return the curvature for the angles of the front wheels: their mean."""
        k = self.params
        tangent = np.tan(angles)
        curves = tangent / (k.wheelbase - self._side * tangent * (k.track / 2.0))
        return float(curves.mean())
