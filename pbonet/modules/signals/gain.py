"""A factor and an offset."""

from typing import Annotated as A

from pbonet import (
    InConst,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.modules._values import PerElement, spread


class Line(Params):
    """Slope and offset, one for each element or one for all."""

    gain: A[PerElement, param("none", "factor, in units of Y per unit of Z")]
    bias: A[PerElement, param("none", "offset, in the unit of Y")] = (0.0,)


class Gain(PortBasedObject[Line], module_class="signal"):
    """y = gain * z + bias."""

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z: A[Vector, InVar("Z", "ndof", "any", "the input")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the scaled value")]

    def init(self) -> None:
        self._take_line()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - both at once
        self._take_line()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self.y[:] = self._gain * self.z + self._bias

    def _take_line(self) -> None:
        k, n = self.params, self.ndof
        self._gain, self._bias = spread(k.gain, n, "gain"), spread(k.bias, n, "bias")
