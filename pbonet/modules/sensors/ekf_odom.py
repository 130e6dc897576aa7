"""Pose of a base on the plane from wheels, gyroscope and occasional pose fixes."""

from math import atan2, cos, pi, sin
from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import is_rotation
from pbonet.modules._wheeled_base import Odometry, motion, turn_slope


class Noise(Params):
    """Standard deviations."""

    speed: A[float, param("m/s", "of V_MEZ, in a cycle", gt=0)] = 0.05
    turn: A[float, param("rad/s", "of the turn in V_MEZ, in a cycle", gt=0)] = 0.1
    gyro: A[float, param("rad/s", "of GYR, in a cycle", gt=0)] = 0.01
    fix: A[float, param("m", "of the position in X_FIX", gt=0)] = 0.05
    heading: A[float, param("rad", "of the heading in X_FIX", gt=0)] = 0.05
    gate: A[
        float, param("none", "largest distance of a fix, in standard deviations", gt=0)
    ] = 5.0


class EkfOdom(PortBasedObject[Noise], module_class="sensor"):
    """An extended Kalman filter of x, y and heading.

    Prediction: the base moves by the exponential of SE(2) of V_MEZ, whose turn is the
    mean of wheels and gyroscope, weighted by their variances. Correction: a new X_FIX,
    of a camera or a laser, with the gain of least variance (Thrun, Burgard and Fox
    2005, chapter 7). A fix counts when it differs from the last one, is not too old by
    its MAXAGE, and is a finite pose; one that is further away than GATE standard
    deviations is left out and reported. While GYR is too old or not finite, the
    wheels alone say how the base turns. It begins with the pose in the table, or at the
    origin, with no uncertainty; height and tilt stay as they are. V_MEZ that is not
    finite ends in ERROR.
    """

    v: A[Vector, InVar("V_MEZ", "3", "mixed", "m/s forward, m/s to the left, rad/s")]
    gyr: A[Vector, InVar("GYR", "3", "rad/s", "angular velocity, z upwards")]
    fix: A[Matrix, InVar("X_FIX", "3,4", "mixed", "measured pose, [R p], p in m")]
    x: A[Matrix, OutVar("X_MEZ", "3,4", "mixed", "estimated pose, [R p], p in m")]
    p: A[
        Matrix,
        OutVar("X_COV", "3,3", "mixed", "covariance of x, y (m) and heading (rad)"),
    ]

    def on(self) -> None:
        self._odometry = Odometry(self.x)
        self.x[:] = self._odometry.pose
        self.p[:] = 0.0
        self._seen = self.fix.copy()
        self._gated = False

    def cycle(self, dt: float) -> None:
        self._predict(dt)
        if self._fix_is_new():
            self._correct()
        self.x[:] = self._odometry.pose

    def _predict(self, dt: float) -> None:
        k = self.params
        x, y, turn = self.v.tolist()
        spread = k.turn * k.turn
        gyro = float(self.gyr[2])
        if not self.task.stale("gyr") and abs(gyro) < np.inf:
            share = spread / (spread + k.gyro * k.gyro)
            turn += share * (gyro - turn)
            spread *= 1.0 - share
        heading = self._heading()
        step = motion(x, y, turn, dt)[:2, 3]
        ahead, left = motion(1.0, 0.0, turn, dt)[:2, 3].tolist()
        across = turn_slope(x, y, turn, dt)
        slope = np.array([
            [ahead, -left, across[0]],
            [left, ahead, across[1]],
            [0.0, 0.0, dt],
        ])
        c, s = cos(heading), sin(heading)
        base = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        way, g = base[:2, :2] @ step, base @ slope
        f = np.array([[1.0, 0.0, -way[1]], [0.0, 1.0, way[0]], [0.0, 0.0, 1.0]])
        self._odometry.move(x, y, turn, dt)
        noise = np.array([k.speed * k.speed, k.speed * k.speed, spread])
        self.p[:] = f @ self.p @ f.T + (g * noise) @ g.T

    def _fix_is_new(self) -> bool:
        if self.task.stale("fix") or np.array_equal(self.fix, self._seen):
            return False
        self._seen[:] = self.fix
        return bool(np.isfinite(self.fix).all() and is_rotation(self.fix[:, :3]))

    def _correct(self) -> None:
        k, pose = self.params, self._odometry.pose
        turned = atan2(self.fix[1, 0], self.fix[0, 0]) - self._heading()
        turned = (turned + pi) % (2.0 * pi) - pi
        away = np.array([*(self.fix[:2, 3] - pose[:2, 3]), turned])
        r = np.diag([k.fix * k.fix, k.fix * k.fix, k.heading * k.heading])
        inverse = np.linalg.inv(self.p + r)
        far = float(away @ inverse @ away) ** 0.5
        if far > k.gate:
            if not self._gated:
                self.task.warn(f"X_FIX is {far:.3g} standard deviations away: left out")
            self._gated = True
            return
        self._gated = False
        gain = self.p @ inverse
        step = gain @ away
        pose[:2, 3] += step[:2]
        pose[:, :3] = motion(0.0, 0.0, float(step[2]), 1.0)[:, :3] @ pose[:, :3]
        rest = np.eye(3) - gain
        self.p[:] = rest @ self.p @ rest.T + gain @ r @ gain.T

    def _heading(self) -> float:
        pose = self._odometry.pose
        return atan2(pose[1, 0], pose[0, 0])
