"""A joystick or game pad: its axes and buttons as variables."""

from typing import Annotated as A, Any

import numpy as np

from pbonet import param
from pbonet.errors import DeviceError, ParameterError
from pbonet.io.drivers import Mode, open_device
from pbonet.modules._values import keep

from ._joystick_ports import Feel, Sticks

RETRY_NS = 1_000_000_000
"""Between two attempts to open a device that was lost."""
FIXED = frozenset({"device", "axes", "buttons"})
"""Parameters that are read when the task is created."""


class Layout(Feel):
    """The device, and which of its ports are read."""

    device: A[str, param("none", "device of agent.toml, driver joystick", device=True)]
    axes: A[
        tuple[int, ...],
        param("none", "port of each axis; minus 1 for none", ge=-1, le=63),
    ] = (0, 1)
    buttons: A[tuple[int, ...], param("none", "ports of the buttons", ge=0, le=831)] = (
        2,
        3,
        4,
        5,
    )


class Joystick(Sticks[Layout]):
    """y = gain * sign(a) * max(abs(a) - dead, 0) / (1 - dead), a of full push 1.

    Each axis goes from -1 to 1 over the range that the device names. The buttons that
    are held are the bits of BUTTONS, the first of the parameter the lowest. When the
    device is lost, axes and buttons are 0, a warning says so, and it is looked for once
    a second until it is back. `deadman` passes the axes on only while a button is held.
    """

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
        super().init()
        self._where = np.flatnonzero(np.array(k.axes) >= 0)
        self._used = [port for port in k.axes if port >= 0]
        self._fault = False
        self._device: Any = None
        self._next_try_ns = self.task.now
        self._poll()  # a missing device is reported at once

    def set(self, name: str, value: object) -> None:
        keep(name, FIXED)
        super().set(name, value)

    def on(self) -> None:
        if self._device is None or not self._device.is_open:
            self._close()  # another task had it
            self._next_try_ns = self.task.now
            self._poll()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self._poll()

    def kill(self) -> None:
        self._close()

    def _close(self) -> None:
        device, self._device = getattr(self, "_device", None), None
        if device:
            device.close()

    def _poll(self) -> None:
        try:
            values = self._values()
        except DeviceError as fault:
            self._close()
            self._next_try_ns = self.task.now + RETRY_NS
            if not self._fault:
                self.task.warn(f"the joystick rests: {fault}")
            self._fault, values = True, None
        push = np.zeros(self.y.size)
        buttons = 0
        if values is not None:
            for where, port in zip(self._where, self._used, strict=True):
                low, high = self._ranges[port]
                push[where] = (2.0 * values[port] - low - high) / (high - low)
            ports = enumerate(self.params.buttons)
            buttons = sum(1 << k for k, port in ports if values[port])
        self._show(push, buttons)

    def _values(self) -> list[int] | None:
        """Return the values of all ports; None: it is not time to look for it."""
        if self._device is None:
            if self.task.now < self._next_try_ns:
                return None
            k = self.params
            last = max((*self._used, *k.buttons), default=0)
            self._device = open_device(k.device, 0, last, mode=Mode.READ, signed=True)
            ranges = [self._device.status("RANGE", port) for port in range(last + 1)]
            self._ranges, self._fault = ranges, False
        values: list[int] = self._device.read()
        return values
