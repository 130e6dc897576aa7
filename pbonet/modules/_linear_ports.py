"""Ports of a device with a linear law: a number of the device for each value."""

from typing import TYPE_CHECKING, Annotated as A, TypeVar

import numpy as np

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError

from ._values import PerElement, keep, spread

if TYPE_CHECKING:
    from collections.abc import Sequence


class Law(Params, kw_only=True):
    """The calibration, one for each element or one for all."""

    scale: A[PerElement, param("none", "the value's unit, for one unit of the device")]
    offset: A[PerElement, param("none", "the value where the device has 0")] = (0.0,)


L = TypeVar("L", bound=Law)


class LinearInput(PortBasedObject[L], abstract=True, module_class="sensor"):
    """y = scale * raw + offset."""

    y: A[Vector, OutVar("Y", "n", "any", "what is measured", new=True)]

    def init(self) -> None:
        self._take_law()
        super().init()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, FIXED)
        self._take_law()

    def cycle(self, dt: float) -> None:
        if raw := self._read(dt):
            np.multiply(self._scale, raw, out=self.y)
            self.y += self._offset

    def _read(self, dt: float) -> "Sequence[int]":
        """Return the raw values; none if there is nothing new."""
        raise NotImplementedError  # abstract: the module and its twin have their own

    def _take_law(self) -> None:
        self._scale, self._offset = law_of(self.params, len(self.y))


class LinearOutput(PortBasedObject[L], abstract=True, module_class="robot interface"):
    """raw = (u - offset) / scale, rounded, and within what a port can have."""

    u: A[
        Vector,
        InVar("U", "n", "any", "wanted values", max_age=0.1, stale="stable"),
    ]
    y: A[Vector, OutVar("Y", "n", "any", "what the device was given", new=True)]

    def init(self) -> None:
        self._take_law()
        super().init()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, FIXED)
        self._take_law()

    def cycle(self, dt: float) -> None:
        if not np.isfinite(self.u).all():
            self.task.fail("U is not finite; the device gets its safe values")
            return
        self._give(self.u, dt)

    def stable(self, dt: float) -> None:
        """Give the device its safe values."""
        self._give(self._safe, dt)

    def _give(self, u: Vector, dt: float) -> None:
        """Give the device values, and say in Y which."""
        raise NotImplementedError  # abstract: the module and its twin have their own

    def _raw(self, u: Vector, low: float, high: float) -> Vector:
        """Return whole numbers for the device, within its ports' range."""
        return np.rint((u - self._offset) / self._scale).clip(low, high)

    def _take_law(self) -> None:
        self._scale, self._offset = law_of(self.params, len(self.y))
        self._safe = self._safe_values()

    def _safe_values(self) -> Vector:
        """Return the values of `stable`."""
        raise NotImplementedError  # abstract: the module and its twin have their own


FIXED = frozenset({"device", "port", "signed", "wait", "safe", "period", "bits"})
"""Parameters that are read when the task is created."""


def law_of(law: Law, n: int) -> tuple[Vector, Vector]:
    """Return scale and offset of each element.

    Raises:
        ParameterError: Their number is wrong, or a scale is 0.
    """
    scale, offset = spread(law.scale, n, "scale"), spread(law.offset, n, "offset")
    if not scale.all():
        raise ParameterError(
            "a scale is 0, with which all raw values are the same",
            expected="another number",
            remedy="negative ones reverse the direction",
        )
    return scale, offset


def port_range(bits: int, *, signed: bool) -> tuple[int, int]:
    """Return the smallest and the largest value of a port; one bit has no sign."""
    if signed and bits > 1:
        return -(1 << (bits - 1)), (1 << (bits - 1)) - 1
    return 0, (1 << bits) - 1
