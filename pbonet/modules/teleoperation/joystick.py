"""A joystick or game pad: its axes and buttons as variables."""

from typing import Annotated as A

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import Joystick as Device
from pbonet.modules._values import PerElement, spread


class Layout(Params):
    """The device, and which of its axes and buttons are read."""

    device: A[str, param("none", "device file, /dev/input/by-id/...-event-joystick")]
    axes: A[
        tuple[int, ...],
        param("none", "codes of the axes, ABS_X is 0; minus 1 for none", ge=-1, le=63),
    ] = (0, 1)
    buttons: A[
        tuple[int, ...],
        param("none", "codes of the buttons, BTN_SOUTH is 304", ge=0, le=767),
    ] = (304, 305, 307, 308)
    gain: A[PerElement, param("none", "value of AXES at full deflection")] = (1.0,)
    dead: A[float, param("none", "share of an axis that is at rest", ge=0, lt=1)] = 0.1


class Joystick(PortBasedObject[Layout], module_class="teleoperation"):
    """y = gain * sign(a) * max(abs(a) - dead, 0) / (1 - dead), a of full push 1.

    Each axis goes from -1 to 1 over the range that the device names. The buttons that
    are held are the bits of BUTTONS, the first of the parameter the lowest. When the
    device is lost, axes and buttons are 0, a warning says so, and it is looked for once
    a second until it is back. `deadman` passes the axes on only while a button is held.
    """

    y: A[Vector, OutVar("AXES", "naxes", "any", "the axes", new=True)]
    buttons: A[
        int, OutVar("BUTTONS", "1", "none", "held buttons, one bit each", new=True)
    ]

    def init(self) -> None:
        k = self.params
        if len(k.axes) != self.y.size:
            raise ParameterError(
                "parameter axes has the wrong number of values",
                expected=f"{self.y.size}, as AXES has elements",
                got=f"{len(k.axes)} values",
                remedy="give each element a code, or -1",
            )
        if len(k.buttons) > 31:  # noqa: PLR2004 - bits of a positive integer
            raise ParameterError("BUTTONS has room for 31 buttons", remedy="take fewer")
        self._gain = spread(k.gain, self.y.size, "gain")
        used = tuple(code for code in k.axes if code >= 0)
        self._where = np.flatnonzero(np.array(k.axes) >= 0)
        self._fault = False
        self._device = Device(k.device, used, k.buttons)
        self._poll()  # a missing device is reported at once

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        if name in {"device", "axes", "buttons"}:
            raise ParameterError(
                f"parameter {name} is read when the task is created",
                remedy="kill the task and spawn it again",
            )
        self._gain = spread(self.params.gain, self.y.size, "gain")

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self._poll()

    def off(self) -> None:
        if not self.task.handover:
            self.y[:] = 0.0
            self.buttons = 0

    def kill(self) -> None:
        if device := getattr(self, "_device", None):
            device.close()

    def _poll(self) -> None:
        stick = self._device.poll(self.task.now)
        fault = self._device.fault
        if fault and not self._fault:
            self.task.warn(f"the joystick rests: {fault}")
        self._fault = fault is not None
        dead = self.params.dead
        push = np.zeros(self.y.size)
        push[self._where] = stick.axes
        size = np.maximum(np.abs(push) - dead, 0.0) / (1.0 - dead)
        self.y[:] = self._gain * np.sign(push) * size
        self.buttons = stick.buttons
