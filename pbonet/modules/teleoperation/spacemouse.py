"""A SpaceMouse: the velocity of a hand from a cap that is pushed and turned."""

from typing import Annotated as A

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import SpaceMouse as Device
from pbonet.modules._values import keep


class Feel(Params):
    """The device, its axes, and the speeds of a full push."""

    device: A[
        str, param("none", "device file, /dev/hidraw0; empty: the first SpaceMouse")
    ] = ""
    axes: A[
        tuple[int, int, int, int, int, int],
        param(
            "none",
            "axis of the cap for each direction, 1 to 6, minus reverses; 0 for none",
            ge=-6,
            le=6,
        ),
    ] = (-2, -1, -3, -5, -4, -6)
    linear: A[float, param("m/s", "speed of a full push", ge=0)] = 0.1
    angular: A[float, param("rad/s", "rate of a full turn", ge=0)] = 0.5
    held: A[float, param("s", "how long a button of a silent cap is held", gt=0)] = 2.0
    dead: A[float, param("none", "share of an axis that is at rest", ge=0, lt=1)] = 0.05


class Spacemouse(PortBasedObject[Feel], module_class="teleoperation"):
    """v = speed * sign(a) * max(abs(a) - dead, 0) / (1 - dead), a of full push 1.

    Axes of the cap are 1 x to the right, 2 y to the person, 3 z down, and 4 to 6 the
    turns about them. AXES says which of them makes the velocity along, and the rate
    about, x, y and z of the base; as it is, x points away from the person, and z up.
    The buttons that are held are the bits of BUTTONS, the left one the lowest. When the
    device is lost, all are 0, a warning says so, and it is looked for once a second
    until it is back. `deadman` passes the velocity on only while a button is held;
    `otg_cart` or `ik_placo` take it on.

    A wireless device may be out of reach. When a pushed cap is silent for 0.25 s, all
    are 0. A cap at rest is always silent, and its buttons count as held for HELD
    more. After that, press the button again: a release may have been lost.
    """

    v: A[Vector, OutVar("X^_CMD", "6", "mixed", "velocity, m/s and rad/s", new=True)]
    buttons: A[
        int, OutVar("BUTTONS", "1", "none", "held buttons, one bit each", new=True)
    ]

    def init(self) -> None:
        self._fault = False
        self._take_axes()
        self._device = Device(self.params.device, held=self.params.held)
        self._poll()  # a missing device is reported at once

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"device", "held"})
        self._take_axes()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self._poll()

    def off(self) -> None:
        if not self.task.handover:
            self.v[:] = 0.0
            self.buttons = 0

    def kill(self) -> None:
        if device := getattr(self, "_device", None):
            device.close()

    def _poll(self) -> None:
        cap = self._device.poll(self.task.now)
        fault = self._device.fault
        if fault and not self._fault:
            self.task.warn(f"the SpaceMouse rests: {fault}")
        self._fault = fault is not None
        dead = self.params.dead
        push = np.array((0.0, *cap.axes))[self._axis]
        size = np.maximum(np.abs(push) - dead, 0.0) / (1.0 - dead)
        np.multiply(self._gain * np.sign(push), size, out=self.v)
        self.buttons = cap.buttons

    def _take_axes(self) -> None:
        k = self.params
        used = sorted(abs(axis) for axis in k.axes if axis)
        if len(set(used)) < len(used):
            raise ParameterError(
                "an axis of the cap makes two motions",
                expected="each of AXES another one, or 0",
                got=" ".join(map(str, k.axes)),
                remedy="give each direction its own axis",
            )
        self._axis = np.abs(np.array(k.axes))
        self._gain = np.sign(np.array(k.axes, dtype=np.float64))
        self._gain *= np.repeat([k.linear, k.angular], 3)
