"""Kinematics and odometry of a base with two driven wheels."""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._wheeled_base import WheeledBase


class Wheels(Params):
    """The wheels."""

    radius: A[float, param("m", "radius of the wheels", gt=0)]
    track: A[float, param("m", "distance between the two wheels", gt=0)]
    limit: A[float, param("rad/s", "largest rate of a wheel", gt=0)] = 1e3


class DiffDrive(PortBasedObject[Wheels], module_class="kinematics"):
    """w = (v -+ turn track / 2) / radius for the left and the right wheel.

    A rate above LIMIT scales both, so that the path keeps its curvature. The pose X_MEZ
    follows from the measured rates, by arcs of circles, and begins with the pose in
    the table, or at the origin. A command to the side cannot be carried out and is
    reported. When V_DES is older than 0.5 s or not finite, and in `stable`, the wheels
    stop and the pose goes on; W_MEZ that is not finite ends in ERROR.
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
    w: A[Vector, InVar("W_MEZ", "2", "rad/s", "measured wheel rates, as W_REF")]
    w_ref: A[Vector, OutVar("W_REF", "2", "rad/s", "wheel rates: left, right")]
    x: A[Matrix, OutVar("X_MEZ", "3,4", "mixed", "pose of the base, [R p], p in m")]
    v: A[Vector, OutVar("V_MEZ", "3", "mixed", "measured velocity, as V_DES")]

    def init(self) -> None:
        self._base = WheeledBase(self.task, sideways=False)
        self._take_wheels()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_wheels()

    def on(self) -> None:
        self._base.begin(self.x)

    def cycle(self, dt: float) -> None:
        self._base.drive(self.v_des, self.w_ref)
        self._base.measure(self.w, dt, self.v, self.x)

    def stable(self, dt: float) -> None:
        """Stop, and go on measuring."""
        self.w_ref[:] = 0.0
        self._base.measure(self.w, dt, self.v, self.x)

    def off(self) -> None:
        if not self.task.handover:
            self.w_ref[:] = 0.0

    def _take_wheels(self) -> None:
        k = self.params
        half = k.track / 2.0
        rows = np.array([[1.0, 0.0, -half], [1.0, 0.0, half]])
        self._base.take_wheels(rows, k.radius, k.limit)
