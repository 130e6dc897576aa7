"""A trajectory generator: sine waves about the previous output."""

from typing import Annotated as A

import numpy as np

from pbonet import InConst, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._values import PerElement, spread

TURN = 2.0 * np.pi


class Wave(Params):
    """The waves, one for each element or one for all."""

    amplitude: A[PerElement, param("none", "amplitude, in the unit of Y")]
    freq: A[PerElement, param("Hz", "cycles per second", ge=0)]
    phase: A[PerElement, param("rad", "initial phase")] = (0.0,)
    fade: A[float, param("s", "time until the full amplitude is reached", gt=0)] = 1.0


class Sine(PortBasedObject[Wave], module_class="trajectory"):
    """y = centre + fade(t) * amplitude * sin(2 pi freq t + phase), and y_dot = dy/dt.

    The centre is where Y stood when the module was turned on, and the amplitude grows
    from zero without a jump in velocity.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Y")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the trajectory")]
    y_dot: A[Vector, OutVar("Y^", "ndof", "any", "its time derivative")]

    def init(self) -> None:
        self._take_wave()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_wave()

    def on(self) -> None:
        self._time = 0.0
        self._centre = self.y.copy()

    def cycle(self, dt: float) -> None:
        self._time += dt
        share, growth = self._fade(self._time)
        angle = self._rate * self._time + self._phase
        self.y[:] = self._centre + share * self._amplitude * np.sin(angle)
        self.y_dot[:] = self._amplitude * (
            growth * np.sin(angle) + share * self._rate * np.cos(angle)
        )

    def _fade(self, time: float) -> tuple[float, float]:
        """Return how much of the amplitude is reached at `time`, and its derivative."""
        x = min(time / self.params.fade, 1.0)
        return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / self.params.fade

    def _take_wave(self) -> None:
        k, n = self.params, self.ndof
        waves = (k.amplitude, "amplitude"), (k.freq, "freq"), (k.phase, "phase")
        amplitude, freq, phase = (spread(values, n, name) for values, name in waves)
        self._amplitude, self._rate, self._phase = amplitude, TURN * freq, phase
