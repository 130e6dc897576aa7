"""The simulated twin of an MPU-6050."""

from typing import Annotated as A

import numpy as np

from pbonet import param
from pbonet.modules._mpu6050 import G, Mpu6050, Ranges
from pbonet.modules._wave import Wave


class Turn(Ranges):
    """Ranges of the chip, and how it turns."""

    amplitude: A[
        tuple[float, float, float], param("rad/s", "of its rate, a sine, x y z")
    ] = (0.0, 0.0, 0.5)
    period: A[float, param("s", "of the sine", gt=0)] = 4.0


class Mpu6050Sim(Mpu6050[Turn]):
    """A level chip that turns by gyr = amplitude * sin(2 pi t / period); acc is 1 g up.

    It has the ports, the ranges and the steps of `mpu6050`, and opens no device: swap
    the two. Its bias is that of the parameters, so that what is shown has none.
    """

    def init(self) -> None:
        super().init()
        k = self.params
        self._wave = Wave((0.0,), k.amplitude, k.period, 3)
        self._up = np.array((0.0, 0.0, G))

    def cycle(self, dt: float) -> None:
        turn = self._wave.after(dt) + self._gyr_bias
        self._show(self._data(self._up + self._acc_bias, turn))
