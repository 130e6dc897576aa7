"""A join connector that falls back to a second output (Stewart 1994, Figure 3.6)."""

from typing import Annotated as A

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector


class JoinFirst(PortBasedObject[Params], module_class="connector"):
    """z = z1 while that is valid, else z2: finite, and no older than its MAXAGE.

    Two modules that produce the same variable get different ones by SVARALIAS, the
    better one Z1, and this module makes the one that others read out of the two. It
    warns when it changes from one to the other, and fails when neither is valid, so
    that no reader takes an old value for a new one; z has the age of the one that is
    taken. Joins can be chained.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z1: A[Vector, InVar("Z1", "ndof", "any", "value of the preferred producer")]
    z2: A[Vector, InVar("Z2", "ndof", "any", "value of the second producer")]
    z: A[Vector, OutVar("Z", "ndof", "any", "the first valid value of the two")]

    def on(self) -> None:
        self._taken = "z1"

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        for port, values in (("z1", self.z1), ("z2", self.z2)):
            if self.task.stale(port) or not np.isfinite(values).all():
                continue
            if port != self._taken:
                self.task.warn(f"{port.upper()} is taken, not {self._taken.upper()}")
                self._taken = port
            self.z[:] = values
            self.task.pass_age_of(port)
            return
        self.task.fail("neither Z1 nor Z2 is finite and no older than its MAXAGE")
