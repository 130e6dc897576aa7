"""A constant value that an operator sets."""

from typing import Annotated as A

from pbonet import InConst, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._values import PerElement, spread


class Setting(Params):
    """The value, one for each element or one for all, and its slew rate."""

    value: A[PerElement, param("none", "the value, in the unit of Y")]
    slew: A[float, param("none", "largest change a second; 0 jumps", ge=0)] = 0.0


class Constant(PortBasedObject[Setting], module_class="teleoperation"):
    """y moves to `value` by at most `slew` a second, and stays there.

    It starts from what Y was when the module is turned on, and `set` changes the value
    while it runs: a set point that never makes its reader jump.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Y")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the value")]

    def init(self) -> None:
        self._take_value()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - both at once
        self._take_value()

    def cycle(self, dt: float) -> None:
        if slew := self.params.slew:
            self.y += (self._value - self.y).clip(-slew * dt, slew * dt)
        else:
            self.y[:] = self._value

    def _take_value(self) -> None:
        self._value = spread(self.params.value, self.ndof, "value")
