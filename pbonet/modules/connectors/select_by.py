"""A connector that selects one of two outputs by an integer variable."""

from typing import Annotated as A

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param


class Choice(Params):
    """The number that selects, and how fast the change is."""

    choice: A[int, param("none", "value of SELECT with which Z2 is taken")] = 1
    blend: A[float, param("s", "duration of a change; 0 jumps", ge=0)] = 0.0


class SelectBy(PortBasedObject[Choice], module_class="connector"):
    """z = z2 while SELECT is CHOICE, else z1.

    A multiplexer (mux) of more inputs is a chain: the z of one is the z1 of the next,
    each with a CHOICE of its own, and SELECT is the same for all. With BLEND, z goes on
    from where it stands after each change, and when the module is turned on: the
    difference between z and the selected value then is added, times 1 - x^2 (3 - 2 x)
    with x the share of BLEND that has passed. The age of z is that of the selected
    input. The other input has no effect, even if it is NaN; if the selected one is, the
    task ends in ERROR.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    select: A[int, InVar("SELECT", "1", "none", "which input is taken")]
    z1: A[Vector, InVar("Z1", "ndof", "any", "taken for every other number")]
    z2: A[Vector, InVar("Z2", "ndof", "any", "taken while SELECT is CHOICE")]
    z: A[Vector, OutVar("Z", "ndof", "any", "the selected value")]

    def init(self) -> None:
        self._away = np.zeros(self.ndof)

    def on(self) -> None:
        self._taken, _ = self._selected()
        self._passed = 0.0
        self._away[:] = self.z

    def cycle(self, dt: float) -> None:
        port, values = self._selected()
        if port != self._taken:
            self._taken, self._passed = port, 0.0
        if self._passed == 0.0:
            self._away = self.z - values
        self._passed += dt
        self.z[:] = values
        if self._passed < self.params.blend:
            x = self._passed / self.params.blend
            self.z += (1.0 - x * x * (3.0 - 2.0 * x)) * self._away
        self.task.pass_age_of(port)

    def _selected(self) -> tuple[str, Vector]:
        if self.select == self.params.choice:
            return "z2", self.z2
        return "z1", self.z1
