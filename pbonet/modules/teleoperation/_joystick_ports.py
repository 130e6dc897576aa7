"""A joystick's ports, and how far it is pushed as a value."""

from typing import Annotated as A, TypeVar

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._values import PerElement, spread


class Feel(Params, kw_only=True):
    """Scale of the axes, and how far they rest."""

    gain: A[PerElement, param("none", "value of AXES at full deflection")] = (1.0,)
    dead: A[float, param("none", "share of an axis that is at rest", ge=0, lt=1)] = 0.1


F = TypeVar("F", bound=Feel)


class Sticks(PortBasedObject[F], abstract=True, module_class="teleoperation"):
    """y = gain * sign(a) * max(abs(a) - dead, 0) / (1 - dead), a of full push 1."""

    y: A[Vector, OutVar("AXES", "naxes", "any", "the axes", new=True)]
    buttons: A[
        int, OutVar("BUTTONS", "1", "none", "held buttons, one bit each", new=True)
    ]

    def init(self) -> None:
        self._take_gain()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all are taken
        self._take_gain()

    def off(self) -> None:
        if not self.task.handover:
            self.y[:] = 0.0
            self.buttons = 0

    def _take_gain(self) -> None:
        self._gain = spread(self.params.gain, self.y.size, "gain")

    def _show(self, push: Vector, buttons: int) -> None:
        """Give the axes, which are pushed so far, and the buttons that are held."""
        dead = self.params.dead
        size = np.maximum(np.minimum(np.abs(push), 1.0) - dead, 0.0) / (1.0 - dead)
        self.y[:] = self._gain * np.sign(push) * size
        self.buttons = buttons
