"""A median filter, which removes single wrong samples."""

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


class Window(Params):
    """The samples of which the median is taken."""

    length: A[int, param("none", "number of samples, odd", ge=1, le=99)] = 3
    begin: A[
        Literal["output", "input"],
        param("none", "it begins with Y as it stands, or with the input"),
    ] = "output"


class Median(PortBasedObject[Window], module_class="signal"):
    """y = the median of the last LENGTH values of z, element by element.

    A value that differs from its neighbours for fewer than half of LENGTH cycles does
    not appear in y; a step comes (LENGTH - 1) / 2 cycles late. A NaN counts as larger
    than any number, so that a single one does not appear either; the task ends in
    ERROR only when the median itself is not finite. At first all samples are what Y
    holds (BEGIN output), or what Z holds (BEGIN input).
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z: A[Vector, InVar("Z", "ndof", "any", "the input")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the median")]

    def init(self) -> None:
        self._next = 0
        self._make_window()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        if name == "length":
            self._make_window()

    def on(self) -> None:
        if self.params.begin == "input":
            self.y[:] = self.z
        self._samples[:] = self.y

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - one sample
        self._samples[self._next] = self.z
        self._next = (self._next + 1) % len(self._samples)
        self._sorted[:] = self._samples
        self._sorted.sort(axis=0)
        self.y[:] = self._sorted[len(self._sorted) // 2]

    def _make_window(self) -> None:
        length = self.params.length
        if length % 2 == 0:
            raise ParameterError(
                "a median is of an odd number of samples",
                expected="LENGTH 3, 5, 7 or so",
                got=f"LENGTH {length}",
                remedy=f"take {length + 1}",
            )
        self._samples = np.tile(self.y, (length, 1))
        self._sorted = self._samples.copy()
        self._next = 0  # the oldest
