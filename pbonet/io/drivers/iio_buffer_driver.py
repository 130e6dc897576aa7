"""Samples of a converter by the kernel's buffer: class ADC, driver ``iio_buffer``.

The address is the device's folder, such as ``/sys/bus/iio/devices/iio:device0``; the
samples come from the device file of that name. Port k is the k-th channel that the
buffer can have: one of the setting `channels`, by default all in the order of their
numbers. A sample has the channels that are opened, all of one moment, and the kernel's
stamp. With a trigger of the kernel they keep their rate whatever the task does.

A device has one buffer, so one opening. While it runs, most devices refuse ``iio_adc``.

Its tests have a folder of plain files and a pipe, and in User-Mode Linux a converter
with a trigger and one without. It was not run with hardware here.
"""

from __future__ import annotations

import errno
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final, NamedTuple

from msgspec import Meta

from pbonet.errors import DeviceError

from .device import Kind, Settings
from .device_classes import FrameDevice, convert
from .iio_driver import by_number
from .modes import Mode
from .stream_waits import read_pieces

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .port_claims import Claim

DEVICE_FILES: Final = "/dev"
_TYPE: Final = re.compile(r"([lb])e:([su])([1-9]\d?)/(8|16|32|64)(?:>>(\d+))?")
_STAMP: Final = "timestamp"
Raw = tuple[list[int], int]
"""Values of the opened channels, and the stamp."""


class IioBufferSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a converter's buffer."""

    channels: tuple[str, ...] = ()
    """Channels such as ``voltage0``, port 0 first; empty: all."""
    trigger: str = ""
    """The kernel's trigger of a sample, by its name; empty: as it is set."""
    length: A[int, Meta(ge=2, le=1 << 20)] = 128
    """Samples that the kernel keeps; it drops the newest."""


class Sample(NamedTuple):
    """The values of one moment."""

    values: list[int]
    """One for each opened port, as elements of the chosen size."""
    stamp_ns: int = 0
    """Nanoseconds since 1970, by the kernel; 0: the device has no stamps."""


class _Element(NamedTuple):
    """A channel's place in a sample, and its form there."""

    name: str
    order: Any
    """Of its bytes: ``little`` or ``big``."""
    is_signed: bool
    bits: int
    size: int
    """Bytes that it has in the sample."""
    shift: int
    """Bits below its lowest one."""
    turn: int
    """Its place in the order of a sample's elements."""


class IioBuffer(FrameDevice[Sample]):
    """Channels of one device, sampled together."""

    kind: ClassVar[Kind] = "ADC"
    can = Mode.READ
    one_port = False
    settings_type: ClassVar[type[Settings]] = IioBufferSettings

    def open(self, claim: Claim | None) -> None:
        """Open the device, and note the channels' bits; see `Device.open`."""
        super().open(claim)
        self._bits: list[int] = self.ask(
            lambda: [one.bits for one in self._elements], default=[]
        )

    def connect(self) -> None:
        """Choose the channels and start the buffer; see `Device.connect`."""
        self._folder = Path(self.entry.address)
        self._fd = -1
        self._held: list[Raw] = []
        o = self.opening
        try:
            names = self._channels()[self.entry.first :]
            self._elements = [self._element(name) for name in names]
            self.check_ports(len(names))
            if o.mode is not Mode.NONE:
                self._start(self._elements[o.start : o.end + 1])
        except DeviceError:
            self.disconnect()
            raise
        except (OSError, ValueError) as error:
            self.disconnect()
            raise self._unusable(error) from None

    def disconnect(self) -> None:
        """Stop the buffer."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with suppress(OSError):
                self._set("buffer/enable", "0")
            os.close(fd)

    def read(self, count: int) -> list[Sample]:
        """Return samples that were taken; see `FrameDevice.read`."""
        self.require(Mode.READ)
        o, found = self.opening, self.ask(self._read, count, default=[])
        bits = self._bits[o.start : o.end + 1]
        how = {"signed": o.signed, "trunc_lsb": o.trunc_lsb}
        return [
            Sample(
                [convert(v, n, o.size, **how) for v, n in zip(raw, bits, strict=True)],
                stamp_ns,
            )
            for raw, stamp_ns in found
        ]

    def _read(self, count: int) -> list[Raw]:
        return read_pieces(self._fd, self._taken, count, self.opening.wait, self._held)

    def _taken(self, limit: int) -> list[Raw]:
        """Return samples that were taken, at most so many; empty if there is none."""
        size = self._size
        try:
            data = os.read(self._fd, limit * size)
        except BlockingIOError:
            return []
        if not data or len(data) % size:
            raise OSError(errno.ENODEV, "the buffer ended")
        return [self._sample(data[k : k + size]) for k in range(0, len(data), size)]

    def _sample(self, data: bytes) -> Raw:
        values = [
            int.from_bytes(data[at : at + one.size], one.order) >> one.shift
            & (1 << one.bits) - 1
            for one, at in self._places
        ]
        return (values[:-1], values[-1]) if self._has_stamp else (values, 0)

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known of the converter; see `Device.status`."""
        if command == "PORTNUM":
            return self.entry.ports or len(self._bits)
        return super().status(command, port)

    def port_bits(self, port: int) -> int:
        """Return how many bits a channel has."""
        return self._bits[port]

    def _channels(self) -> list[str]:
        """Return all channels that the buffer can have, or those of the settings.

        Raises:
            DeviceError: The device has no buffer, or no such channel.
        """
        files = [one.name for one in (self._folder / "scan_elements").iterdir()]
        form = re.compile(r"in_(.+)_en")
        found = sorted(
            (match[1] for match in map(form.fullmatch, files) if match), key=by_number
        )
        self._has_stamp = _STAMP in found
        self._all = list(found)
        if self._has_stamp:
            found.remove(_STAMP)
        for name in self.settings.channels:
            if name not in found:
                raise DeviceError(
                    "the buffer has no such channel",
                    where=self._where(),
                    expected=" ".join(found) or "scan_elements/in_*_en",
                    got=name,
                    remedy="see channels in agent.toml",
                )
        return list(self.settings.channels) or found

    def _element(self, name: str) -> _Element:
        """Return a channel's form in the samples.

        Raises:
            DeviceError: It is not known.
        """
        text = self._get(f"scan_elements/in_{name}_type")
        match = _TYPE.fullmatch(text)
        if match is None:
            raise DeviceError(
                "the type of a channel has a form that is not known",
                where=f"{self._where()}, channel {name}",
                expected="such as le:s12/16>>4",
                got=text,
                remedy="name other channels in agent.toml",
            )
        order, sign, bits, storage, shift = match.groups()
        return _Element(
            name,
            "little" if order == "l" else "big",
            sign == "s",
            int(bits),
            int(storage) // 8,
            int(shift or 0),
            int(self._get(f"scan_elements/in_{name}_index")),
        )

    def _start(self, chosen: Sequence[_Element]) -> None:
        """Let the kernel take samples of some channels.

        Raises:
            OSError: It does not.
        """
        wanted = [*chosen, *([self._element(_STAMP)] if self._has_stamp else [])]
        self._fd = os.open(  # it has one user, so that the rest is this one's
            os.path.join(DEVICE_FILES, self._folder.name),  # noqa: PTH118
            os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC,
        )
        names = {one.name for one in wanted}
        for name in self._all:
            self._set(f"scan_elements/in_{name}_en", str(int(name in names)))
        if (self._folder / "current_timestamp_clock").exists():
            self._set("current_timestamp_clock", "realtime")
        if self.settings.trigger:
            self._set("trigger/current_trigger", self.settings.trigger)
        self._set("buffer/length", str(self.settings.length))
        self._set("buffer/enable", "1")
        self._place(wanted)

    def _place(self, wanted: Sequence[_Element]) -> None:
        """Note where each element is in a sample: aligned to its own size, by turn."""
        at, places = 0, dict[str, int]()
        for one in sorted(wanted, key=lambda one: one.turn):
            at = -(-at // one.size) * one.size
            places[one.name] = at
            at += one.size
        largest = max(one.size for one in wanted)
        self._size = -(-at // largest) * largest
        self._places = [(one, places[one.name]) for one in wanted]

    def _get(self, name: str) -> str:
        return (self._folder / name).read_text(encoding="ascii").strip()

    def _set(self, name: str, value: str) -> None:
        fd = os.open(self._folder / name, os.O_WRONLY | os.O_CLOEXEC)
        try:
            os.write(fd, value.encode() + b"\n")
        except OSError as error:
            raise OSError(error.errno, f"{name}: {error.strerror}") from None
        finally:
            os.close(fd)

    def _where(self) -> str:
        return f"{self.name} ({self.entry.address})"

    def _unusable(self, error: Exception) -> DeviceError:
        return DeviceError(
            "the converter's buffer cannot be started",
            where=self._where(),
            expected="a folder of /sys/bus/iio/devices with scan_elements",
            got=getattr(error, "strerror", None) or str(error),
            remedy="set trigger in agent.toml to the name of one of "
            "/sys/bus/iio/devices/trigger*; check that no other program has the buffer",
        )
