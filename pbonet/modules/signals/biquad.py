"""A digital filter of second order: low-pass, high-pass or notch."""

from math import cos, pi, sin
from typing import Annotated as A, Literal

import numpy as np

from pbonet import (
    InConst,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.errors import ParameterError


class Design(Params):
    """Kind and frequency of the filter."""

    kind: A[
        Literal["low", "high", "notch"],
        param("none", "what passes: low or high frequencies, or all but one"),
    ]
    frequency: A[float, param("Hz", "corner, or the frequency that is removed", gt=0)]
    q: A[float, param("none", "quality; 0.7071 is Butterworth's", gt=0)] = 0.5**0.5
    begin: A[
        Literal["output", "input"],
        param("none", "it begins with Y as it stands, or settled at the input"),
    ] = "output"


class Biquad(PortBasedObject[Design], module_class="signal"):
    """y[k] = b0 z[k] + b1 z[k-1] + b2 z[k-2] - a1 y[k-1] - a2 y[k-2].

    The coefficients are those of an analogue filter of second order by the bilinear
    transform, exact at FREQUENCY (Bristow-Johnson, "Cookbook formulae for audio
    equalizer biquad filter coefficients"). They follow the task's frequency, which must
    be more than twice FREQUENCY. With BEGIN output the filter begins as if
    y had always been what Y holds, so that it takes over from another writer without a
    step; with BEGIN input as if z had always been what it is, so that a measurement is
    right from the first cycle. A value that is not finite ends in ERROR, and the next
    `on` begins again. After a missed cycle the filter is that much later.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z: A[Vector, InVar("Z", "ndof", "any", "the input")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the filtered value")]

    def init(self) -> None:
        self._past = np.zeros((4, self.ndof))  # z, y one cycle ago; z, y two ago
        self._design()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._design()

    def on(self) -> None:
        if self.params.begin == "input":
            self.y[:] = 0.0 if self.params.kind == "high" else self.z
        self._past[:] = self.z, self.y, self.z, self.y

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - one sample
        if self.task.freq != self._freq:
            self._design()
        self.y[:] = self._now * self.z + self._before @ self._past
        self._past[2:] = self._past[:2]
        self._past[0], self._past[1] = self.z, self.y

    def _design(self) -> None:
        k, freq = self.params, self.task.freq
        if not 2.0 * k.frequency < freq:
            raise ParameterError(
                "the filter's frequency is too high for the task",
                expected=f"FREQUENCY below {freq / 2:g} Hz, half the task's",
                got=f"{k.frequency:g} Hz",
                remedy="raise FREQ, or lower FREQUENCY",
            )
        (b0, b1, b2), (a1, a2) = coefficients(k.kind, k.frequency / freq, k.q)
        self._now, self._before = b0, np.array([b1, -a1, b2, -a2])
        self._freq = freq


def coefficients(
    kind: str, share: float, q: float
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return (b0, b1, b2) and (a1, a2), with a0 = 1.

    Args:
        kind: ``"low"``, ``"high"`` or ``"notch"``.
        share: The filter's frequency over the sampling rate.
        q: The quality.
    """
    c, alpha = cos(2.0 * pi * share), sin(2.0 * pi * share) / (2.0 * q)
    b0, b1 = {
        "low": ((1.0 - c) / 2.0, 1.0 - c),
        "high": ((1.0 + c) / 2.0, -1.0 - c),
        "notch": (1.0, -2.0 * c),
    }[kind]
    a0 = 1.0 + alpha
    return (b0 / a0, b1 / a0, b0 / a0), (-2.0 * c / a0, (1.0 - alpha) / a0)
