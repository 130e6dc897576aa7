"""A trajectory that is played from a file."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    Vector,
    param,
)
from pbonet.errors import ParameterError
from pbonet.io import read_samples
from pbonet.modules._values import rest


class Playing(Params):
    """The file, and how it is played."""

    file: A[str, param("none", ".csv or .npz file, in a folder of modules")]
    lead: A[float, param("s", "time to go from where Y stands to the start", gt=0)] = (
        1.0
    )
    speed: A[float, param("none", "factor of the speed", gt=0)] = 1.0
    repeat: A[bool, param("none", "whether it repeats at its end")] = False


class TrajPlay(PortBasedObject[Playing], module_class="trajectory"):
    """y = the samples of a file at their times, joined by cubic Hermite pieces.

    The samples have times of their own, whatever the task's rate. Each piece has the
    values and derivatives of the file at both ends; where the file has no derivatives,
    those of second-order differences. First y goes in LEAD seconds from where it
    stands, at rest or with the velocity of a predecessor, to the first sample, by such
    a piece. At the end it rests in the last sample and the signal FINISH is sent, or,
    if it repeats, it goes in LEAD seconds to the first one again.

    A .csv file has a column of seconds and NDOF of values, perhaps NDOF more of
    derivatives; a .npz file has the arrays `time`, `values` and perhaps `rates`.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Y")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the trajectory")]
    y_dot: A[Vector, OutVar("Y^", "ndof", "any", "its time derivative")]

    def init(self) -> None:
        found = read_samples(self.params.file, self.ndof, self.task.libraries)
        self._times = found.time - found.time[0]
        self._values, self._rates = found.values, found.rates

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        if name == "file":
            raise ParameterError(
                "parameter file is read when the task is created",
                remedy="kill the task and spawn it again",
            )

    def on(self) -> None:
        rest(self.task, self.y_dot)
        self._from = self.y.copy(), self.y_dot.copy()
        self._lead = self.params.lead  # set() changes that of the next time
        self._time = -self._lead  # of the file, or before it
        self._rests = False

    def cycle(self, dt: float) -> None:
        if self._rests:
            return
        speed, end = self.params.speed, float(self._times[-1])
        if self._time >= 0.0:
            self._time += dt * speed
        else:
            self._time += dt
            self._time *= speed if self._time > 0.0 else 1.0
        if self._time < 0.0:
            self._go_to_the_start(speed)
        elif self._time < end:
            self._play(speed)
        elif self.params.repeat:
            self._from = self._values[-1], self._rates[-1] * speed
            self._lead = self.params.lead
            self._time = (self._time - end) / speed - self._lead
            self._go_to_the_start(speed)
        else:
            self.y[:], self.y_dot[:] = self._values[-1], 0.0
            self._rests = True
            self.task.signal(Signal.FINISH)

    def off(self) -> None:
        rest(self.task, self.y_dot)

    def _go_to_the_start(self, speed: float) -> None:
        goal = self._values[0], self._rates[0] * speed
        share = min((self._time + self._lead) / self._lead, 1.0)
        self.y[:], self.y_dot[:] = hermite(share, self._lead, self._from, goal)

    def _play(self, speed: float) -> None:
        k = int(np.searchsorted(self._times, self._time, side="right")) - 1
        span = float(self._times[k + 1] - self._times[k])
        begin, goal = ((self._values[i], self._rates[i]) for i in (k, k + 1))
        share = (self._time - float(self._times[k])) / span
        self.y[:], rate = hermite(share, span, begin, goal)
        self.y_dot[:] = speed * rate


def hermite(
    x: float, span: float, begin: tuple[Vector, Vector], goal: tuple[Vector, Vector]
) -> tuple[Vector, Vector]:
    """Return value and derivative of the cubic between two values with derivatives.

    Args:
        x: Share of the time, 0 to 1.
        span: Its length, s.
        begin: Value and derivative at 0.
        goal: Value and derivative at 1.
    """
    (y, v), (z, w) = begin, goal
    up = x * x * (3.0 - 2.0 * x)
    value = y + up * (z - y) + span * x * (1.0 - x) * ((1.0 - x) * v - x * w)
    rate = (
        6.0 * x * (1.0 - x) / span * (z - y)
        + (1.0 - x) * (1.0 - 3.0 * x) * v
        + x * (3.0 * x - 2.0) * w
    )
    return value, rate
