"""The simulated twin of a Robotiq FT 300."""

from typing import Annotated as A

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._ft300_frames import FORCE, TORQUE
from pbonet.modules._values import PerElement
from pbonet.modules._wave import Wave


class Load(Params):
    """The load of the sensor: N, then N*m."""

    mean: A[PerElement, param("none", "mean wrench, six values, or one for all")] = (
        0.0,
    )
    amplitude: A[PerElement, param("none", "of a sine, the same")] = (0.0,)
    period: A[float, param("s", "of the sine", gt=0)] = 4.0


class Ft300Sim(PortBasedObject[Load], module_class="sensor"):
    """f = mean + amplitude * sin(2 pi t / period), in steps of 0.01 N and 0.001 N*m.

    It has the port of `ft300` and opens no device: swap the two. Its task is periodic,
    because nothing gives it the time.
    """

    f: A[Vector, OutVar("F_RAW", "6", "mixed", "wrench, N and N*m", new=True)]

    def init(self) -> None:
        self._steps = np.repeat((FORCE, TORQUE), 3)
        self._take_load()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_load()

    def cycle(self, dt: float) -> None:
        np.multiply(np.rint(self._wave.after(dt) / self._steps), self._steps, self.f)

    def _take_load(self) -> None:
        k = self.params
        self._wave = Wave(k.mean, k.amplitude, k.period, 6)
