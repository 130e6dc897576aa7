"""Lines that carry Modbus: a connection (TCP), or a serial line (RTU)."""

from __future__ import annotations

import errno
import struct
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from pbonet.errors import DeviceError

from . import inet_sockets
from .modbus_frames import REFUSAL, REFUSED, Request, no_answer_to_this
from .request_line import AT_ONCE, Line
from .serial_turns import SharedLine

if TYPE_CHECKING:
    import socket

_SHORTEST: Final = 0.00175
"""Seconds of silence between two frames of RTU, however fast the line is."""
_UNITS: Final = range(1, 248)


class TcpLine(Line[Request]):
    """Modbus TCP: a header with a number before each request."""

    _HEADER: Final = struct.Struct(">HHHB")
    _SIZES: Final = range(2, 255)
    """Of a frame beyond the header's first six bytes."""

    def __init__(
        self, connection: socket.socket, unit: int, timeout: float, where: str
    ) -> None:
        super().__init__(timeout, where)
        self.unit = unit
        self._socket = connection
        self._numbers = count(1)
        self._number = 0

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def give(self, data: bytes) -> int:
        """Hand bytes over; return how many were taken."""
        return inet_sockets.send(self._socket, data)

    def taken(self) -> bytes:
        """Return bytes that have come."""
        return inet_sockets.receive(self._socket, AT_ONCE)

    def framed(self, request: Request) -> bytes:
        """Return a request with its header."""
        data = request.data
        self._number = next(self._numbers) & 0xFFFF
        return self._HEADER.pack(self._number, 0, len(data) + 1, self.unit) + data

    def unframed(self, request: Request) -> bytes | None:
        """Return the answer; the answer to a request that was given up is dropped.

        Raises:
            OSError: These are no frames of Modbus, and none can be found any more.
        """
        del request  # the header says how long its answer is
        while len(self._in) >= self._HEADER.size:
            number, protocol, size, _ = self._HEADER.unpack_from(self._in)
            if protocol or size not in self._SIZES:
                raise OSError(errno.EPROTO, "it does not talk Modbus")
            end = self._HEADER.size - 1 + size
            if len(self._in) < end:
                return None
            frame = bytes(self._in[self._HEADER.size : end])
            del self._in[:end]
            if number == self._number:
                return frame
        return None


class RtuLine(SharedLine[Request]):
    """Modbus RTU: the line to one unit.

    Args:
        path: The device file.
        settings: Of the serial line: baud, parity, stop.
        unit: The number of the device on it.
        timeout: Seconds in which it answers, its wait for a turn included.
        where: For errors.

    Raises:
        DeviceError: The serial line cannot be opened, or is open with other settings;
            there is no such unit.
    """

    def __init__(
        self, path: str, settings: dict[str, Any], unit: int, timeout: float, where: str
    ) -> None:
        if unit not in _UNITS:
            raise DeviceError(
                "the device cannot be reached so",
                where=where,
                expected="unit 1 to 247 on a serial line",
                got=str(unit),
                remedy="see unit in agent.toml",
            )
        super().__init__(path, settings, timeout, where)
        self.unit, self.gap = unit, max(_SHORTEST, 3.5 * 11 / settings["baud"])

    def framed(self, request: Request) -> bytes:
        """Return a request with its checksum."""
        body = bytes((self.unit,)) + request.data
        return body + crc(body).to_bytes(2, "little")

    def unframed(self, request: Request) -> bytes | None:
        """Return the answer.

        Raises:
            DeviceError: It is damaged, or not an answer to this request.
        """
        got = self._in
        if len(got) < REFUSAL:
            return None
        if got[0] != self.unit or got[1] & ~REFUSED != request.function:
            raise no_answer_to_this(self.where, bytes(got))
        end = 1 + (REFUSAL if got[1] & REFUSED else request.size) + 2
        if len(got) < end:
            return None
        if crc(got[: end - 2]) != int.from_bytes(got[end - 2 : end], "little"):
            raise no_answer_to_this(self.where, bytes(got))
        return bytes(got[1 : end - 2])


def crc(data: bytes | bytearray) -> int:
    """Return the checksum of Modbus RTU."""
    value = 0xFFFF
    for byte in data:
        value = value >> 8 ^ _CRC[(value ^ byte) & 0xFF]
    return value


def _crc_of(value: int) -> int:
    for _ in range(8):
        value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value


_CRC: Final = tuple(map(_crc_of, range(256)))
