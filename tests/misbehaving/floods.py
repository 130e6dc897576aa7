"""Sends more signals than notices can carry."""

from typing import Annotated as A

from pbonet import (
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    UserSignal,
    Vector,
    param,
)


class Amount(Params):
    """How many."""

    total: A[int, param("none", "signals to send in all", ge=0)]
    burst: A[int, param("none", "signals in a cycle", ge=1)] = 100


class Floods(PortBasedObject[Amount]):
    """Sends DROP, FINISH and WARNING in turn until `total` were sent."""

    DROP = UserSignal(0, "one more")

    y: A[Vector, OutVar("Y", "2", "none", "signals sent, and 0")]

    def on(self) -> None:
        self.y[:] = 0.0

    def cycle(self, dt: float) -> None:
        left = self.params.total - int(self.y[0])
        for n in range(min(left, self.params.burst)):
            match (int(self.y[0]) + n) % 3:
                case 0:
                    self.task.signal(self.DROP, "a drop in the flood")
                case 1:
                    self.task.signal(Signal.FINISH)
                case _:
                    self.task.warn("wet")
        self.y[0] += min(left, self.params.burst)
