"""Devices for the modules of the library that have one, as they are measured.

Converters are folders of plain files; a chip and two drives answer from memory, so that
what is measured is the module, and not a bus.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING, ClassVar

from pbonet.io.drivers import Entry, Frame, FrameDevice, PortDevice, Wait

if TYPE_CHECKING:
    from collections.abc import Sequence
    from contextlib import ExitStack
    from pathlib import Path

    from pbonet.io.drivers.device import Kind

_LEVEL = bytes((1, 0, 0, 0, 0, 0x20, 0, 0, 0, 0, 0, 0, 0, 0, 0))
"""What an MPU-6050 has that lies level."""
_IT_IS = 0x68
_ENABLED = 0x0237
"""The status word of a drive that is enabled."""


def entries(folder: Path, channels: int, stack: ExitStack) -> dict[str, Entry]:
    """Return devices by the names that the library's RMODs give.

    Args:
        folder: Where files of converters are made.
        channels: How many each converter has.
        stack: Where a serial line is closed.
    """
    for k in range(channels):
        for name in ("in_voltage", "in_count", "out_voltage"):
            (folder / f"{name}{k}_raw").write_text("100\n")
    counts = tuple(f"count{k}" for k in range(channels))
    volts = tuple(f"voltage{k}" for k in range(channels))
    here = __name__
    ends = os.openpty()
    for end in ends:
        stack.callback(os.close, end)
    return {
        "adc0": _converter("iio_adc", folder, volts),
        "counters": _converter("iio_adc", folder, counts),
        "dac0": _converter("iio_dac", folder, volts),
        "imu": Entry(driver=f"{here}:Chip", address="chip"),
        "servos": Entry(driver=f"{here}:Servos", address="line"),
        "can0": Entry(driver=f"{here}:Drives", address="bus"),
        "force": Entry(driver="serial", address=os.ttyname(ends[1])),
    }


def _converter(driver: str, folder: Path, channels: tuple[str, ...]) -> Entry:
    return Entry(driver=driver, address=str(folder), settings={"channels": channels})


class Chip(PortDevice):
    """An MPU-6050 that always has a new measurement."""

    kind: ClassVar[Kind] = "PIO"

    def connect(self) -> None:
        """Connect with nothing."""

    def disconnect(self) -> None:
        """Leave it."""

    def read_ports(self) -> Sequence[int]:
        """Return its name, or what it measures."""
        return _LEVEL if self.opening.start else (_IT_IS,)

    def write_ports(self, values: Sequence[int]) -> None:
        """Take a setting."""


class Servos(Chip):
    """Servos that stand still, and always have a new measurement."""

    kind: ClassVar[Kind] = "RCB"
    waits = frozenset({Wait.ALL, Wait.NONE})

    def read_ports(self) -> Sequence[int]:
        """Return current, speed and place."""
        return [0] * (self.opening.end - self.opening.start + 1)

    def port_bits(self, port: int) -> int:
        """Return the size of the largest register."""
        del port
        return 32


class Drives(FrameDevice[Frame]):
    """Two drives that are enabled, and send what they measure when they are read."""

    usual_ports = 1

    def connect(self) -> None:
        """Begin with drives that are not set up."""
        self._answers: list[Frame] = []
        self._mode = 0

    def disconnect(self) -> None:
        """Leave them."""

    def read(self, count: int) -> list[Frame]:
        """Return answers to requests, then signs of life and measurements."""
        frames, self._answers = self._answers, []
        data = (
            struct.pack("<Hi", _ENABLED, 1000),
            struct.pack("<ihb", 10, 5, self._mode),
        )
        for node in (1, 2):
            frames.append(Frame(0x700 + node, b"\5"))
            frames.append(Frame(0x180 + node, data[0]))
            frames.append(Frame(0x280 + node, data[1]))
        return frames[:count]

    def write(self, frames: Sequence[Frame]) -> int:
        """Answer requests that set an object, and take everything else."""
        for frame in frames:
            if frame.id & 0x780 == 0x600:
                self._answers.append(
                    Frame(frame.id - 0x80, b"\x60" + frame.data[1:4] + bytes(4))
                )
                if frame.data[1:3] == b"\x60\x60":
                    self._mode = frame.data[4]
        return len(frames)
