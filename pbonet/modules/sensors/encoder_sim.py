"""The simulated twin of encoders."""

from math import pi
from typing import Annotated as A

import numpy as np

from pbonet import param
from pbonet.modules._counts import Counts, Reading, Scale
from pbonet.modules._values import PerElement
from pbonet.modules._wave import Wave


class Motion(Scale):
    """The meaning of a count, and the motion of the shafts."""

    mean: A[PerElement, param("rad", "middle of the motion")] = (0.0,)
    amplitude: A[PerElement, param("rad", "of the motion, a sine")] = (1.0,)
    period: A[float, param("s", "of the sine", gt=0)] = 4.0


class EncoderSim(Counts[Motion]):
    """q = mean + amplitude * sin(2 pi t / period), in whole counts that wrap.

    It has the ports and the law of `encoder`, and opens no device: swap the two. The
    counters begin at 0, and each turn of an encoder has an index.
    """

    def init(self) -> None:
        super().init()
        k = self.params
        self._wave = Wave(k.mean, k.amplitude, k.period, len(self.q))
        self._turn = np.zeros(len(self.q))

    def _read(self, dt: float) -> Reading:
        turns = (self._wave.after(dt) - self._zero) / (2.0 * pi)
        turns *= np.array(self.params.gear)
        whole = np.rint(turns * np.array(self.params.counts)).astype(np.int64)
        turn = np.floor(turns)
        at = turn != self._turn
        self._turn = turn
        return Reading((whole & ((1 << self._bits) - 1)).tolist(), at.tolist())
