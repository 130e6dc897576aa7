"""A dead man's switch: a command holds only while a person holds a button."""

from typing import Annotated as A, Literal

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._values import PerElement, spread


class Grip(Params):
    """The button, and what holds without it."""

    button: A[int, param("none", "number of the button in BUTTONS", ge=1, le=31)] = 1
    release: A[
        Literal["value", "hold"],
        param("none", "without the button Y is RELEASED, or keeps its value"),
    ] = "value"
    released: A[PerElement, param("none", "that value, in the unit of Y")] = (0.0,)
    maxage: A[float, param("s", "largest age of BUTTONS", gt=0)] = 0.2


class Deadman(PortBasedObject[Grip], module_class="teleoperation"):
    """y = z while the button is held, else RELEASED, or what y was.

    Button 1 is the lowest bit of BUTTONS. A button counts as not held when BUTTONS is
    older than MAXAGE, and when z is not finite, which is reported. The module that
    writes BUTTONS must see that a silent device holds no button; for `spacemouse` that
    takes up to its HELD. The button must be let go
    before it counts again; so too when the module is turned on with the button held.
    RELEASE value is for velocities, RELEASE hold for positions: there `limits`, after
    this module, makes the way to z smooth. Without the button, y is new; with it, y has
    the age of z.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    buttons: A[int, InVar("BUTTONS", "1", "none", "held buttons, one bit each")]
    z: A[Vector, InVar("Z", "ndof", "any", "the command of a person")]
    y: A[Vector, OutVar("Y", "ndof", "any", "the command that holds")]

    def init(self) -> None:
        self._take_value()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        self._take_value()

    def on(self) -> None:
        self._armed = self._held = False

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        fault = self._fault()
        pressed = bool(self.buttons >> (self.params.button - 1) & 1)
        if fault:
            self._armed = False
            if self._held:
                self.task.warn(f"the button counts as released: {fault}")
        elif not pressed:
            self._armed = True
        self._held = pressed and self._armed
        if self._held:
            self.y[:] = self.z
            self.task.pass_age_of("z")
            return
        if self.params.release == "value":
            self.y[:] = self._released
        self.task.stamp_ns = self.task.now

    def off(self) -> None:
        if self.params.release == "value" and not self.task.handover:
            self.y[:] = self._released

    def _fault(self) -> str:
        age = self.task.age("buttons")
        if self.task.stale("buttons") or age > self.params.maxage:
            return f"BUTTONS is {age:.3g} s old"
        bad = np.flatnonzero(~np.isfinite(self.z))
        return f"Z[{bad[0]}] is not finite" if bad.size else ""

    def _take_value(self) -> None:
        self._released = spread(self.params.released, self.ndof, "released")
