"""Registers of a device on an I2C bus: class PIO, driver ``i2c``.

The address is BUS:DEVICE, such as ``/dev/i2c-1:0x48``. Physical port k is register k
of the settings' list.
"""

from __future__ import annotations

import re
from contextlib import suppress
from fcntl import ioctl
from importlib import import_module
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Final, Literal

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io import from_extra

from .device import Kind, Settings
from .device_classes import PortDevice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.config import Entry
    from pbonet.outside import Outside

    from .modes import Opening

_ADDRESS: Final = re.compile(r"(.+):0x([0-7][0-9a-f])")
_I2C_SLAVE: Final = 0x0703
"""Request of <linux/i2c-dev.h>: the device that is meant from now on."""
_BYTE: Final = 8
_BLOCK: Final = 32
"""Bytes of the longest transfer."""


class I2cSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of registers on an I2C bus."""

    registers: A[tuple[A[int, Meta(ge=0, le=255)], ...], Meta(min_length=1)]
    """The number of each physical port's register."""
    bits: Literal[8, 16] = 8
    """Bits of each register."""
    order: Literal["little", "big"] = "little"
    """Which byte of 16 bits comes first on the bus."""
    burst: bool = False
    """Whether registers that follow each other are read in one transfer, and so at one
    time: for chips that count the register on by themselves."""


class I2cDevice(PortDevice):
    """Registers of one device, read and written by SMBus commands."""

    kind: ClassVar[Kind] = "PIO"
    settings_type: ClassVar[type[Settings]] = I2cSettings
    packages: ClassVar[tuple[str, ...]] = ("smbus2",)

    def __init__(self, entry: Entry, opening: Opening, outside: Outside) -> None:
        super().__init__(entry, opening, outside)
        k = self.settings
        found = _ADDRESS.fullmatch(entry.address)
        if found is None:
            raise DeviceError(
                "the address of the device is wrong",
                where=f"[device.{self.name}]",
                expected="BUS:DEVICE, such as /dev/i2c-1:0x48",
                got=entry.address,
                remedy="`i2cdetect -y 1` lists what answers on bus 1",
            )
        self._count = len(k.registers) - entry.first
        self.check_ports(self._count)
        self._path, self._address = found[1], int(found[2], 16)
        begin, end = entry.first + opening.start, entry.first + opening.end
        self._registers = k.registers[begin : end + 1]
        self._runs = runs(self._registers, k.bits // _BYTE) if k.burst else []
        self._is_swapped = k.bits > _BYTE and k.order == "big"  # SMBus has little

    def connect(self) -> None:
        """Open the bus; see `Device.connect`."""
        with from_extra("i2c", f"the device {self.name}"):
            smbus2: Any = import_module("smbus2")
        self._bus: Any = smbus2.SMBus()
        try:
            self._bus.open(self._path)
            ioctl(self._bus.fd, _I2C_SLAVE, self._address)
        except OSError as error:
            self.disconnect()
            raise DeviceError(
                "the I2C bus cannot be opened",
                where=f"{self.name} ({self.entry.address})",
                expected="a device file of i2c-dev, no driver of the kernel at DEVICE",
                got=error.strerror or str(error),
                remedy="`modprobe i2c-dev`; `i2cdetect -l` lists the buses",
            ) from None
        byte = self.settings.bits == _BYTE
        self._get = self._bus.read_byte_data if byte else self._bus.read_word_data
        self._put = self._bus.write_byte_data if byte else self._bus.write_word_data

    def disconnect(self) -> None:
        """Close the bus."""
        with suppress(OSError):
            self._bus.close()

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known of the device; it has a port for each register."""
        if command == "PORTNUM":
            return self.entry.ports or self._count
        return super().status(command, port)

    def port_bits(self, port: int) -> int:
        """Return how many bits a register has."""
        del port
        bits: int = self.settings.bits
        return bits

    def read_ports(self) -> list[int]:
        """Return the registers of the opened ports."""
        if self._runs:
            return self._read_runs()
        return [
            self._ordered(self._get(self._address, register))
            for register in self._registers
        ]

    def _read_runs(self) -> list[int]:
        """Return the same in as few transfers as can be."""
        data, step = bytearray(), self.settings.bits // _BYTE
        for first, count in self._runs:
            data += bytes(self._bus.read_i2c_block_data(self._address, first, count))
        order = self.settings.order
        return [
            int.from_bytes(data[k : k + step], order) for k in range(0, len(data), step)
        ]

    def write_ports(self, values: Sequence[int]) -> None:
        """Write the registers of the opened ports, one after the other."""
        for register, value in zip(self._registers, values, strict=True):
            self._put(self._address, register, self._ordered(value))

    def _ordered(self, value: int) -> int:
        """Return a value with its bytes in the device's order."""
        return (value & 0xFF) << 8 | value >> 8 if self._is_swapped else value


def runs(registers: Sequence[int], step: int) -> list[tuple[int, int]]:
    """Return transfers for registers: the first register and the bytes of each.

    Args:
        registers: In the order of their ports.
        step: Bytes of a register.
    """
    found: list[tuple[int, int]] = []
    for register in registers:
        first, count = found[-1] if found else (0, 0)
        # Such a chip numbers bytes.
        if found and register == first + count and count + step <= _BLOCK:
            found[-1] = first, count + step
        else:
            found.append((register, step))
    return found
