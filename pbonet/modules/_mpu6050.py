"""The registers of the MPU-6050 (InvenSense, register map RM-MPU-6000A)."""

import struct
from typing import Annotated as A, Final, Literal, TypeVar

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param

from ._values import keep

WHO_AM_I, ITS_NAME = 0x75, 0x68
SETUP: Final = (0x6B, 0x19, 0x1A, 0x1B, 0x1C)
"""PWR_MGMT_1, SMPLRT_DIV, CONFIG, GYRO_CONFIG and ACCEL_CONFIG."""
DATA: Final = tuple(range(0x3A, 0x49))
"""INT_STATUS, then acceleration, temperature and rate, each the high byte first."""
REGISTERS: Final = (WHO_AM_I, *SETUP, *DATA)
"""The registers in the order of the device's ports."""
IS_NEW: Final = 1
"""Bit of INT_STATUS: there are values that were not read."""
BY_CLOCK_OF_GYRO: Final = 1
"""PWR_MGMT_1: awake, with the clock of the gyroscope, which is the most exact one."""
INNER_HZ: Final = 1000.0
"""Rate at which the chip measures with its filter on; SMPLRT_DIV divides it."""
RATES: Final = {"250": 0, "500": 1, "1000": 2, "2000": 3}
FORCES: Final = {"2": 0, "4": 1, "8": 2, "16": 3}
FILTERS: Final = {"184": 1, "94": 2, "44": 3, "21": 4, "10": 5, "5": 6}
G: Final = 9.80665
_FULL: Final = 32768.0
_WORDS: Final = struct.Struct(">7h")


class Ranges(Params, kw_only=True):
    """Ranges of the chip, and its zero."""

    gyro_range: A[
        Literal["250", "500", "1000", "2000"], param("deg/s", "largest rate")
    ] = "500"
    acc_range: A[
        Literal["2", "4", "8", "16"], param("none", "largest acceleration, in 1 g")
    ] = "4"
    gyro_bias: A[
        tuple[float, float, float], param("rad/s", "what it shows at rest, x y z")
    ] = (0.0, 0.0, 0.0)
    acc_bias: A[
        tuple[float, float, float],
        param("m/s^2", "what it shows beside gravity at rest, x y z"),
    ] = (0.0, 0.0, 0.0)


R = TypeVar("R", bound=Ranges)


class Mpu6050(PortBasedObject[R], abstract=True, module_class="sensor"):
    """The law of the chip; a module says where its registers come from."""

    acc: A[
        Vector,
        OutVar("ACC", "3", "m/s^2", "specific force; at rest 1 g upwards", new=True),
    ]
    gyr: A[
        Vector,
        OutVar("GYR", "3", "rad/s", "angular velocity in the chip's axes", new=True),
    ]

    def init(self) -> None:
        self._take_ranges()
        super().init()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"device", "gyro_range", "acc_range", "filter"})
        self._take_ranges()

    def _show(self, data: bytes) -> None:
        """Take acceleration, temperature and rate, as the chip has them."""
        x, y, z, _, a, b, c = _WORDS.unpack(data)
        np.multiply((x, y, z), self._acc_scale, out=self.acc)
        np.multiply((a, b, c), self._gyr_scale, out=self.gyr)
        self.acc -= self._acc_bias
        self.gyr -= self._gyr_bias

    def _data(self, acc: Vector, gyr: Vector) -> bytes:
        """Return what the chip has of an acceleration and a rate."""
        words = [*(acc / self._acc_scale), 0.0, *(gyr / self._gyr_scale)]
        return _WORDS.pack(*np.rint(words).clip(-_FULL, _FULL - 1).astype(int).tolist())

    def _take_ranges(self) -> None:
        k = self.params
        self._acc_scale = float(k.acc_range) * G / _FULL
        self._gyr_scale = float(k.gyro_range) * np.pi / 180.0 / _FULL
        self._acc_bias, self._gyr_bias = np.array(k.acc_bias), np.array(k.gyro_bias)
