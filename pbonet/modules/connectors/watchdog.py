"""A connector that passes on a variable only while it is as it should be."""

from typing import Annotated as A, Literal

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.modules._values import PerElement, spread

FINE, OLD, NOT_FINITE, OUTSIDE = range(4)


class Watch(Params):
    """The right values, and the reaction to others."""

    safe: A[PerElement, param("none", "value of Y while Z is wrong, in its unit")]
    lower: A[PerElement, param("none", "smallest right value of Z")] = (-1e12,)
    upper: A[PerElement, param("none", "largest right value of Z")] = (1e12,)
    maxage: A[float, param("s", "largest right age of Z; 0 for any", ge=0)] = 0.0
    settle: A[float, param("s", "time that Z must be right to end it", ge=0)] = 0.0
    action: A[
        Literal["flag", "illegal", "error"],
        param("none", "what a wrong Z does: FLAG; the illegal flag too; or ERROR"),
    ] = "flag"


class Watchdog(PortBasedObject[Watch], module_class="connector"):
    """y = z and FLAG = 0 while z is right, else y = SAFE and FLAG says why.

    FLAG is 1 when z is older than MAXAGE or the MAXAGE of its variable, 2 when it is
    not finite, 3 when an element is not within LOWER and UPPER. When z has been right
    for SETTLE seconds, FLAG is 0 again. ACTION flag does no more than that; illegal
    raises the illegal-configuration flag as long, so that CRITICAL tasks run `stable`;
    error ends the task in ERROR, and y keeps its value and gets older. Each fault is
    reported by a warning. While z is right, y has its age; SAFE is new. A z that may
    be NaN needs `FINITE no` in the .svar file.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z: A[Vector, InVar("Z", "ndof", "any", "the value that is watched")]
    y: A[Vector, OutVar("Y", "ndof", "any", "it, or the safe value")]
    flag: A[int, OutVar("FLAG", "1", "none", "0 right, 1 old, 2 not finite, 3 outside")]

    def init(self) -> None:
        self._take_parameters()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_parameters()

    def on(self) -> None:
        self._state = FINE
        self._right = 0.0
        self._raised = False

    def cycle(self, dt: float) -> None:
        fault = self._judge()
        if fault != FINE:
            self._right = 0.0
            if fault != self._state:
                self._report(fault)
        elif self._state != FINE:
            self._right += dt
            if self._right < self.params.settle:
                fault = self._state
            elif self._raised:
                self._raised = False
                self.task.legal()
        self._state = self.flag = fault
        self.y[:] = self.z if fault == FINE else self._safe
        if fault != FINE:
            self.task.stamp_ns = self.task.now
        elif self.params.maxage:
            self.task.pass_age_of("z")

    def _judge(self) -> int:
        limit = self.params.maxage
        if self.task.stale("z") or (limit and self.task.age("z") > limit):
            return OLD
        if not np.isfinite(self.z).all():
            return NOT_FINITE
        inside = (self._lower <= self.z) & (self.z <= self._upper)
        return FINE if inside.all() else OUTSIDE

    def _report(self, fault: int) -> None:
        if fault == OLD:
            text = f"Z is {self.task.age('z'):.3g} s old, which is too old"
        elif fault == NOT_FINITE:
            text = f"Z[{np.flatnonzero(~np.isfinite(self.z))[0]}] is not finite"
        else:
            k = np.flatnonzero((self.z < self._lower) | (self.z > self._upper))[0]
            limits = f"{self._lower[k]:g} to {self._upper[k]:g}"
            text = f"Z[{k}] is {self.z[k]:g}, not within {limits}"
        if self.params.action == "error":
            self.task.fail(text)
        if self.params.action == "illegal":
            self._raised = True
            self.task.illegal(text)
        self.task.warn(text)

    def _take_parameters(self) -> None:
        k, n = self.params, self.ndof
        self._safe, self._lower, self._upper = (
            spread(k.safe, n, "safe"),
            spread(k.lower, n, "lower"),
            spread(k.upper, n, "upper"),
        )
        if (self._lower > self._upper).any():
            raise ParameterError(
                "no value of Z is right",
                expected="LOWER at most UPPER",
                got=f"LOWER {k.lower}, UPPER {k.upper}",
                remedy="exchange the two",
            )
