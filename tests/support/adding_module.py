"""A module whose every copy depends on time, age and cycle, for tests of logs."""

ADDS = '''
from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param


class Gain(Params):
    """How much is added."""

    gain: A[float, param("1", "of the input")] = 1.0


class Adds(PortBasedObject[Gain]):
    """Adds its input up, with the time and its own age."""

    n: A[int, InConst("N", "1", "size")]
    z: A[Vector, InVar("Z", "n", "none", "input")]
    y: A[Vector, OutVar("Y", "n", "none", "sum")]

    def init(self) -> None:
        self.age = 0.1

    def on(self) -> None:
        self.age += self.task.now * 1e-9

    def cycle(self, dt: float) -> None:
        self.age += dt / 3.0
        self.y += self.params.gain * self.z * dt + self.age + self.task.now * 1e-12

    def off(self) -> None:
        self.y[0] = self.task.cyclecount
        self.y[1] += self.task.handover
'''

SVAR = (
    "NAME N\nTYPE int\nDESC size\nUNITS none\nNELEM 1\nINIT 2\n\n"
    "NAME X\nTYPE double\nDESC input\nUNITS none\nNELEM 2\nINIT 1 2\n\n"
    "NAME Y\nTYPE double\nDESC sum\nUNITS none\nNELEM 2\n\nEOF\n"
)
"""An `.svar` file for two tasks of the module in a line."""
