"""The devices that a task has open for writing: made safe whenever it is not ON.

A task's executor makes its own `Openings` the current one before it runs code of the
module. `open_device` enters what it opens there. A program without an executor has one
for all.
"""

from __future__ import annotations

from typing import Protocol


class Writer(Protocol):
    """An open device with safe values."""

    def write_safe(self, *, wait: bool = True) -> None:
        """Write the safe values; see `pbonet.io.drivers.Device`."""

    def close(self) -> None:
        """Write the safe values and close the device."""


class Openings:
    """The open devices of one task that have safe values, the oldest first."""

    def __init__(self) -> None:
        self._open: list[Writer] = []

    def add(self, device: Writer) -> None:
        """Enter a device that was opened."""
        self._open.append(device)

    def remove(self, device: Writer) -> None:
        """Forget a device that was closed or lost; harmless if it is not here."""
        self._open = [one for one in self._open if one is not device]

    def repeat(self) -> None:
        """Write the safe values of all devices in a cycle, as a module would.

        Raises:
            DeviceError: A device is gone.
        """
        for device in self._open:
            device.write_safe(wait=False)

    def make_safe(self, *, close: bool) -> list[Exception]:
        """Write the safe values of all devices; return what could not be done.

        Args:
            close: Close them as well: the task ends.
        """
        errors: list[Exception] = []
        for device in self._open:
            try:
                (device.close if close else device.write_safe)()
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
