"""The simulated twin of a sensor with a linear law."""

from typing import TYPE_CHECKING, Annotated as A

import numpy as np

from pbonet import param
from pbonet.modules._linear_ports import Law, LinearInput
from pbonet.modules._values import PerElement
from pbonet.modules._wave import Wave

if TYPE_CHECKING:
    from collections.abc import Sequence


class Course(Law):
    """The calibration, and the course of what is measured."""

    mean: A[PerElement, param("none", "mean value, in the unit of Y")] = (0.0,)
    amplitude: A[PerElement, param("none", "of a sine, in the unit of Y")] = (0.0,)
    period: A[float, param("s", "of the sine", gt=0)] = 10.0


class LinearSensorSim(LinearInput[Course]):
    """y = mean + amplitude * sin(2 pi t / period), in steps of SCALE.

    It has the ports and the law of `linear_sensor`, and opens no device: swap the two.
    """

    def init(self) -> None:
        super().init()
        k = self.params
        self._wave = Wave(k.mean, k.amplitude, k.period, len(self.y))

    def set(self, name: str, value: object) -> None:
        super().set(name, value)
        if name in {"mean", "amplitude"}:
            k = self.params
            self._wave = Wave(k.mean, k.amplitude, k.period, len(self.y))

    def _read(self, dt: float) -> "Sequence[int]":
        raw = np.rint((self._wave.after(dt) - self._offset) / self._scale)
        whole: list[int] = raw.astype(int).tolist()
        return whole
