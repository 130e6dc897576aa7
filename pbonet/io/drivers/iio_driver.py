"""Converters of Linux's industrial I/O: classes ADC and DAC, by files of sysfs.

The address is the device's folder, such as ``/sys/bus/iio/devices/iio:device0``. Port k
is the k-th channel: one of the setting `channels`, by default all that can be read
(``iio_adc``) or written (``iio_dac``), in the order of their numbers. A counter of an
encoder is a channel of ``iio_adc`` too, such as ``count0``.

Its tests have a folder of plain files in place of sysfs, and converters of a kernel in
User-Mode Linux. It was not run with hardware here.
"""

from __future__ import annotations

import errno
import os
import re
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final, NoReturn

from msgspec import Meta

from pbonet.errors import DeviceError

from .device import Kind, Settings
from .device_classes import PortDevice
from .modes import Mode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .port_claims import Claim

_MOST: Final = 32
"""Characters of a value, and more than any has."""
_REFUSALS: Final = frozenset({errno.EBUSY, errno.EAGAIN, errno.EINVAL, errno.ERANGE})
"""Errors of a device that is there, and does not do this now."""


class IioSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a converter."""

    channels: tuple[str, ...] = ()
    """Channels such as ``voltage0``, port 0 first; empty: all."""
    bits: A[int, Meta(ge=1, le=64)] = 16
    """Bits of a channel whose type the kernel does not tell (``scan_elements``)."""


class _IioDevice(PortDevice):
    """Channels of one direction."""

    settings_type: ClassVar[type[Settings]] = IioSettings
    way: ClassVar[str]
    """How the names of its files begin."""
    flags: ClassVar[int]
    """How they are opened."""

    def open(self, claim: Claim | None) -> None:
        """Open the device, and note the channels' types; see `Device.open`."""
        super().open(claim)
        found = self.ask(lambda: self._found, default=None)
        self._types: list[tuple[int, bool]] = [(bits, sign) for bits, sign in found]

    def connect(self) -> None:
        """Open the channels' files; see `Device.connect`."""
        self._fds: list[int] = []
        names = self._channels()[self.entry.first :]
        self._types = self._found = [self._type(name) for name in names]
        o = self.opening
        if o.end >= len(names):
            raise DeviceError(
                "the device has no such ports",
                where=self._where(),
                expected=f"0 to {len(names) - 1}" if names else f"{self.way}_*_raw",
                got=f"{o.start} to {o.end}",
                remedy="see channels and first in agent.toml",
            )
        self._names = names[o.start : o.end + 1]
        if o.mode is Mode.NONE:
            return
        try:
            for name in self._names:
                path = self._path(f"{self.way}_{name}_raw")
                self._fds.append(os.open(path, self.flags | os.O_CLOEXEC))
        except OSError as error:
            self.disconnect()
            raise self._unusable(error) from None

    def disconnect(self) -> None:
        """Close the channels' files."""
        fds, self._fds = self._fds, []
        for fd in fds:
            os.close(fd)

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known of the converter; see `Device.status`."""
        if command == "PORTNUM":
            return self.entry.ports or len(self._types)
        return super().status(command, port)

    def port_bits(self, port: int) -> int:
        """Return how many bits a channel has.

        Raises:
            DeviceError: There is no such port.
        """
        if not 0 <= port < len(self._types):
            raise DeviceError(
                "the device has no such ports",
                where=self.name,
                expected=f"0 to {len(self._types) - 1}",
                got=str(port),
                remedy="see channels and first in agent.toml",
            )
        return self._types[port][0]

    def _channels(self) -> list[str]:
        """Return all channels of the device, or those of the settings.

        Raises:
            DeviceError: There is no such folder, or no such channel.
        """
        try:
            files = os.listdir(self.entry.address)  # noqa: PTH208
        except OSError as error:
            raise self._unusable(error) from None
        form = re.compile(rf"{self.way}_(.+)_raw")
        found = sorted(
            (match[1] for match in map(form.fullmatch, files) if match), key=by_number
        )
        chosen: tuple[str, ...] = self.settings.channels
        for name in chosen:
            if name not in found:
                raise DeviceError(
                    f"the device has no such {self.way}put channel",
                    where=self._where(),
                    expected=" ".join(found) or f"files {self.way}_*_raw",
                    got=name,
                    remedy="see channels in agent.toml",
                )
        return list(chosen) or found

    def _type(self, channel: str) -> tuple[int, bool]:
        """Return how many bits a channel has, and whether it has a sign.

        Raises:
            DeviceError: The kernel's word for it is of another form.
        """
        path = self._path("scan_elements", f"{self.way}_{channel}_type")
        try:
            with open(path, encoding="ascii") as file:  # noqa: PTH123
                text = file.read().strip()
        except FileNotFoundError:
            return self.settings.bits, False
        except (OSError, ValueError) as error:
            raise self._unusable(error) from None
        match = re.match(r"[lb]e:([su])([1-9]\d?)/\d+", text)
        if match is None:
            raise DeviceError(
                "the type of a channel has a form that is not known",
                where=path,
                expected="such as le:s12/16>>4",
                got=text,
                remedy="name other channels in agent.toml",
            )
        return int(match[2]), match[1] == "s"

    def _refused(self, k: int, error: OSError) -> NoReturn:
        """Raise what a channel's error means.

        Raises:
            DeviceError: The device is there, and refuses.
            OSError: It is gone.
        """
        if error.errno not in _REFUSALS:
            raise error
        raise DeviceError(
            "the device refuses a channel's value",
            where=f"{self._where()}, channel {self._names[k]}",
            got=error.strerror or str(error),
            remedy="check the value's range, and that no buffer of the device runs",
        )

    def _path(self, *names: str) -> str:
        return os.path.join(self.entry.address, *names)  # noqa: PTH118

    def _where(self) -> str:
        return f"{self.name} ({self.entry.address})"

    def _unusable(self, error: Exception) -> DeviceError:
        return DeviceError(
            "the converter cannot be opened",
            where=self._where(),
            expected="a folder of /sys/bus/iio/devices",
            got=str(error),
            remedy="check the folder, and the rights of the files in it",
        )


class IioAdc(_IioDevice):
    """A converter from analogue values, or a counter."""

    kind: ClassVar[Kind] = "ADC"
    can = Mode.READ
    way = "in"
    flags = os.O_RDONLY

    def read_ports(self) -> Sequence[int]:
        """Return the raw values of the opened channels."""
        return [self._value(k, fd) for k, fd in enumerate(self._fds)]

    def _value(self, k: int, fd: int) -> int:
        """Return a channel's value.

        Raises:
            DeviceError: It is no number, or has more bits than the channel.
            OSError: The device is gone.
        """
        try:
            text = os.pread(fd, _MOST, 0)
        except OSError as error:
            self._refused(k, error)
        bits = self._found[self.opening.start + k][0]
        try:
            value = int(text)
            if -1 << (bits - 1) <= value < 1 << bits:
                return value
        except ValueError:
            pass
        raise DeviceError(
            "a channel's value is no number of its size",
            where=f"{self._where()}, channel {self._names[k]}",
            expected=f"a number of {bits} bits",
            got=repr(text.decode(errors="replace")),
            remedy="see bits in agent.toml",
        )


class IioDac(_IioDevice):
    """A converter to analogue values."""

    kind: ClassVar[Kind] = "DAC"
    can = Mode.WRITE
    way = "out"
    flags = os.O_WRONLY

    def write_ports(self, values: Sequence[int]) -> None:
        """Write raw values to the opened channels."""
        for k, (fd, raw) in enumerate(zip(self._fds, values, strict=True)):
            bits, signed = self._found[self.opening.start + k]
            value = raw - (1 << bits) if signed and raw >> (bits - 1) else raw
            try:
                os.pwrite(fd, b"%d\n" % value, 0)
            except OSError as error:
                self._refused(k, error)


def by_number(channel: str) -> list[tuple[str, int]]:
    """Return a key that sorts ``voltage2`` before ``voltage10``."""
    return [
        (text, int(digits or -1)) for text, digits in re.findall(r"(\D+)(\d*)", channel)
    ]
