"""A device on an SPI bus: class SIO, driver ``spi``.

The address is the device file, such as ``/dev/spidev0.0``. A transfer writes and reads
the same number of bytes, with the device selected from the first to the last. It takes
as long as the bus takes for them. A device that is missing looks like one that answers
zeros or ones.

Its tests have a bus that a test makes up, and spidev in User-Mode Linux on a bus that
sends back what it is sent. It was not run with hardware here.
"""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final, Literal

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io import from_extra

from .device import Settings
from .device_classes import StreamDevice
from .modes import Mode, Wait

if TYPE_CHECKING:
    from collections.abc import Callable

_MOST: Final = 4096
"""Bytes of one transfer; the kernel's own limit, where that is usual."""


class SpiSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of a device on an SPI bus."""

    mode: Literal[0, 1, 2, 3] = 0
    """Polarity and phase of the clock."""
    speed: A[int, Meta(gt=0)] = 500_000
    """Bits a second, at most."""
    lsb_first: bool = False
    cs_high: bool = False
    """Whether the device is selected by a high voltage."""


class SpiDevice(StreamDevice):
    """One chip select of a bus."""

    settings_type: ClassVar[type[Settings]] = SpiSettings
    packages: ClassVar[tuple[str, ...]] = ("spidev",)
    waits = frozenset({Wait.ALL})
    default_wait = Wait.ALL

    def connect(self) -> None:
        """Open the bus; see `Device.connect`."""
        with from_extra("spi", f"the device {self.name}"):
            spidev: Any = import_module("spidev")
        k = self.settings
        self._bus: Any = spidev.SpiDev()
        try:
            self._bus.open_path(self.entry.address)
            self._bus.mode = k.mode
            self._bus.max_speed_hz = k.speed
            for name, value in (("lsbfirst", k.lsb_first), ("cshigh", k.cs_high)):
                if value:  # not every bus can be asked for it
                    setattr(self._bus, name, value)
        except OSError as error:
            self.disconnect()
            raise DeviceError(
                "the SPI bus cannot be opened",
                where=f"{self.name} ({self.entry.address})",
                expected="a device file of spidev that takes these settings",
                got=error.strerror or str(error),
                remedy="`ls /dev/spidev*` lists them; check their rights, and mode, "
                "lsb_first and cs_high in agent.toml",
            ) from None

    def disconnect(self) -> None:
        """Close the bus."""
        with suppress(OSError):
            self._bus.close()

    def read(self, count: int) -> bytes:
        """Return `count` bytes, while zeros are written; see `StreamDevice.read`."""
        self.require(Mode.READ)
        data: bytes = self._asked(self._transfer, bytes(count))
        return data

    def write(self, data: bytes) -> int:
        """Write bytes, and forget those that are read; see `StreamDevice.write`."""
        self.require(Mode.WRITE)
        self._asked(self._transfer_out, data)
        return len(data)

    def transfer(self, data: bytes) -> bytes:
        """Write bytes; return those that the device gave in the same time.

        Raises:
            DeviceError: The device is gone, or not open for both; there are more bytes
                than one transfer has.
        """
        self.require(Mode.RW)
        answer: bytes = self._asked(self._transfer, data)
        return answer

    def check_safe(self) -> None:
        """Refuse safe bytes that are not those of one transfer."""
        self._must_fit(self.safe)

    def _asked(self, call: Callable[[bytes], Any], data: bytes) -> Any:  # noqa: ANN401
        self._must_fit(data)
        return self.ask(call, data, default=None)

    def _must_fit(self, data: bytes) -> None:
        if not 0 < len(data) <= _MOST:
            raise DeviceError(
                "a transfer has no such length",
                where=self.name,
                expected=f"1 to {_MOST} bytes",
                got=str(len(data)),
                remedy="make several transfers",
            )

    def _transfer(self, data: bytes) -> bytes:
        return bytes(self._bus.xfer2(list(data)))

    def _transfer_out(self, data: bytes) -> None:
        self._bus.xfer2(list(data))
