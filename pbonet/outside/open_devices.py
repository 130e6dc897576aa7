"""The devices that a task has open: made safe, or given up, whenever it is not ON.

A task's executor makes its own `Openings` the current one before it runs code of the
module. `open_device` enters what it opens there. A program without an executor has one
for all.
"""

from __future__ import annotations

from typing import Any, Protocol


class Opened(Protocol):
    """An open device."""

    safe: Any
    """Its safe values; None: it is left as it is."""

    def is_wanted(self) -> bool:
        """Return whether another task waits for one of its ports."""
        ...

    def write_safe(self, *, wait: bool = True) -> None:
        """Write the safe values; see `pbonet.io.drivers.Device`."""

    def give_up(self) -> None:
        """Write the safe values, close the device if it took them, and wait for it."""

    def close(self) -> None:
        """Write the safe values and close the device."""


class Openings:
    """The open devices of one task, the oldest first."""

    def __init__(self) -> None:
        self._open: list[Opened] = []

    def add(self, device: Opened) -> None:
        """Enter a device that was opened."""
        self._open.append(device)

    def remove(self, device: Opened) -> None:
        """Forget a device that was closed or lost; harmless if it is not here."""
        self._open = [one for one in self._open if one is not device]

    def repeat(self) -> None:
        """Write the safe values of all devices in a cycle, as a module would.

        Raises:
            DeviceError: A device is gone.
        """
        for device in self._open:
            if device.safe is not None:
                device.write_safe(wait=False)

    def make_safe(self, *, close: bool) -> list[Exception]:
        """Write the safe values of all devices; return what could not be done.

        Where another task waits for one of them, all are given up: it may need others
        of them as well, and was refused at the first one.

        Args:
            close: Close them in any case: the task ends.
        """
        errors: list[Exception] = []
        try:
            wanted = [device for device in self._open if device.is_wanted()]
        except OSError as error:  # without that they still have safe values
            wanted = []
            errors.append(error)
        for device in self._open:
            try:
                if close:
                    device.close()
                elif wanted:
                    device.give_up()
                elif device.safe is not None:
                    device.write_safe()
            except Exception as error:  # noqa: BLE001 - the driver may be anybody's
                errors.append(error)
        return errors


_current = [Openings()]


def use(openings: Openings) -> None:
    """Have devices that are opened from now on entered here."""
    _current[0] = openings


def current() -> Openings:
    """Return where devices are entered now."""
    return _current[0]
