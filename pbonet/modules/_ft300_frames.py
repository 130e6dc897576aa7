"""Frames of the data stream of a Robotiq FT 300 force torque sensor.

A frame is 20 4E, six numbers of 16 bits with the low byte first, in 0.01 N and
0.001 N m, and the CRC of Modbus over all of these. The stream is begun by a request of
Modbus RTU, which writes 0200h to register 410 of unit 9, and ended by bytes FF.
"""

from __future__ import annotations

import struct
from typing import Final

HEAD: Final = b"\x20\x4e"
LENGTH: Final = 16
FORCE, TORQUE = 0.01, 0.001
"""N and N m of one unit."""
END: Final = b"\xff" * 50
_NUMBERS: Final = struct.Struct("<6h")
_CRC: Final = struct.Struct("<H")


def crc(data: bytes) -> bytes:
    """Return the checksum of Modbus RTU."""
    found = 0xFFFF
    for byte in data:
        found ^= byte
        for _ in range(8):
            found = found >> 1 ^ (0xA001 if found & 1 else 0)
    return _CRC.pack(found)


_BEGIN: Final = bytes((9, 0x10, 0x01, 0x9A, 0, 1, 2, 0x02, 0x00))
BEGIN: Final = _BEGIN + crc(_BEGIN)


class Frames:
    """Finds frames in a stream that may begin anywhere and be damaged.

    Attributes:
        damaged: Bytes that were left out because they belong to no frame.
    """

    def __init__(self) -> None:
        self._held = b""
        self.damaged = 0

    def newest(self, data: bytes) -> tuple[int, ...] | None:
        """Take bytes; return the numbers of the last whole frame in them, if any."""
        held = self._held + data
        found, at = None, 0
        while (at := self._next(held, at)) + LENGTH <= len(held):
            frame = held[at : at + LENGTH]
            if crc(frame[:-2]) == frame[-2:]:
                found = _NUMBERS.unpack(frame[2:-2])
                at += LENGTH
            else:
                at += 1
                self.damaged += 1
        self._held = held[at:]
        return found

    def _next(self, held: bytes, at: int) -> int:
        """Return where the next frame may begin; at most its first byte is there."""
        begin = held.find(HEAD, at)
        if begin < 0:
            begin = len(held) - (held[-1:] == HEAD[:1] and len(held) > at)
        self.damaged += begin - at
        return begin

    def forget(self) -> None:
        """Forget the beginning of a frame: what follows does not belong to it."""
        self.damaged += len(self._held)
        self._held = b""
