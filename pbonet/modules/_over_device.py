"""When a module over a device opens it and closes it."""

from contextlib import suppress
from typing import Any, TypeVar

from pbonet import Answer, Params, PortBasedObject
from pbonet.errors import DeviceError, DeviceTakenError

P = TypeVar("P", bound=Params)
NEVER = 1
"""A time stamp of values that were not measured: they are too old for every limit."""


class OverDevice(PortBasedObject[P], abstract=True):
    """A module over one device, opened in `init`.

    When the task fails or ends the device is closed, and so has its safe values; `on`
    opens it again. So it does where another task had the device in `init`, or got it
    while this one was OFF: the two can take each other's place.
    """

    _device: Any = None

    def init(self) -> None:
        try:
            self._device = self._open()
        except DeviceTakenError as error:
            self.task.warn(f"it is opened when this task is turned on: {error}")

    def on(self) -> None:
        if self._device is None or not self._device.is_open:
            self._give_up()
            self._device = self._open()

    def error(self, error: Exception) -> Answer:  # noqa: ARG002 - whichever it is
        for device in self._opened():
            with suppress(DeviceError):  # it may be lost, or refuse its safe values
                device.give_up()
        return Answer.ERROR

    def kill(self) -> None:
        self._give_up()

    def _open(self) -> Any:  # noqa: ANN401 - its class is that of the driver
        """Return the opened device."""
        raise NotImplementedError

    def _opened(self) -> list[Any]:
        """Return the devices that were opened; they may have been closed."""
        return [] if self._device is None else [self._device]

    def _give_up(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            with suppress(DeviceError):  # it may be lost
                device.close()


class HeardOf(OverDevice[P], abstract=True):
    """A sensor that may have nothing new: its outputs are as old as its last values.

    A sensor that is silent for longer than `_longest` ends in ERROR.
    """

    _heard: int = 0

    def on(self) -> None:
        super().on()
        self._heard, self.task.stamp_ns = self.task.now, NEVER

    def _note(self, *, new: bool) -> None:
        """Note whether this cycle had new values."""
        now = self.task.now
        if new:
            self._heard = self.task.stamp_ns = now
        elif now - self._heard > self._longest() * 1e9:
            self.task.fail(f"the sensor has sent nothing for {self._longest():g} s")

    def _longest(self) -> float:
        """Return how many seconds the sensor may be silent."""
        raise NotImplementedError
