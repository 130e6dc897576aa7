"""Orientation from an inertial measurement unit, by a complementary filter."""

from math import cos, sin, sqrt
from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.io import is_rotation
from pbonet.modules._quaternion import (
    Quaternion,
    level,
    matrix_of,
    product,
    quaternion_of,
)


class Fusion(Params):
    """Gains of the filter."""

    kp: A[float, param("1/s", "how fast the tilt follows the accelerometer", ge=0)] = (
        1.0
    )
    ki: A[float, param("1/s^2", "how fast the gyroscope's bias is learned", ge=0)] = 0.1
    gravity: A[float, param("m/s^2", "acceleration at rest", gt=0)] = 9.80665
    band: A[
        float,
        param("m/s^2", "largest difference from it at which ACC is used", gt=0),
    ] = 2.0


class ImuFusion(PortBasedObject[Fusion], module_class="sensor"):
    """R' = R [w]x with w = gyr - bias + kp e, bias' = -ki e, e = unit(acc) x R^T z.

    The explicit complementary filter of Mahony, Hamel and Pflimlin (2008): the
    gyroscope turns the orientation, exactly for a constant rate; where the
    accelerometer points up slowly corrects its tilt. The turn about the vertical has no
    such reference and drifts with the bias. While ACC differs from gravity in size by
    more than BAND the sensor accelerates, and only the gyroscope counts. It begins with
    the orientation in the table, or, if there is none, level with the accelerometer. A
    value that is not finite ends in ERROR; the learned bias remains.
    """

    acc: A[Vector, InVar("ACC", "3", "m/s^2", "specific force; at rest 1 g upwards")]
    gyr: A[Vector, InVar("GYR", "3", "rad/s", "angular velocity in the sensor's axes")]
    att: A[
        Matrix, OutVar("ATT_MEZ", "3,3", "none", "orientation R of the sensor, z up")
    ]
    rate: A[Vector, OutVar("GYR_MEZ", "3", "rad/s", "angular velocity without bias")]

    def init(self) -> None:
        self._bias = 0.0, 0.0, 0.0

    def on(self) -> None:
        if is_rotation(self.att):
            self._q = quaternion_of(self.att)
            return
        x, y, z = self.acc.tolist()
        if not x * x + y * y + z * z > 0.0:
            self.task.fail("ACC is 0 or not finite, so that nothing says what is up")
        self._q = level(x, y, z)
        self.att[:] = matrix_of(self._q)

    def cycle(self, dt: float) -> None:
        e, f, g = self._error()
        kp, step = self.params.kp, self.params.ki * dt
        b, c, d = self._bias
        b, c, d = b - step * e, c - step * f, d - step * g
        x, y, z = self.gyr.tolist()
        x, y, z = x - b, y - c, z - d
        self.rate[:] = x, y, z
        self._q = _turned(self._q, x + kp * e, y + kp * f, z + kp * g, dt)
        self.att[:] = matrix_of(self._q)
        if np.isfinite(self.att).all():
            self._bias = b, c, d

    def _error(self) -> tuple[float, float, float]:
        """Return the axis of the tilt's error times its sine, in the sensor's axes."""
        x, y, z = self.acc.tolist()
        size = sqrt(x * x + y * y + z * z)
        if abs(size - self.params.gravity) > self.params.band or size == 0.0:
            return 0.0, 0.0, 0.0
        w, i, j, k = self._q  # the vertical is the last row of R
        u, v, n = (
            2.0 * (i * k - w * j),
            2.0 * (j * k + w * i),
            1 - 2.0 * (i * i + j * j),
        )
        return (y * n - z * v) / size, (z * u - x * n) / size, (x * v - y * u) / size


def _turned(q: Quaternion, x: float, y: float, z: float, dt: float) -> Quaternion:
    """Return an orientation turned by an angular velocity in its own axes."""
    rate = sqrt(x * x + y * y + z * z)
    half = 0.5 * rate * dt
    part = sin(half) / rate if rate > 0.0 else 0.5 * dt
    w, i, j, k = product(q, (cos(half), part * x, part * y, part * z))
    size = sqrt(w * w + i * i + j * j + k * k)
    return w / size, i / size, j / size, k / size
