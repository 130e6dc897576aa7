"""Modbus TCP: requests and answers with a header, on a connection."""

from __future__ import annotations

import errno
import struct
from itertools import count
from typing import TYPE_CHECKING, Final

from . import inet_sockets
from .modbus_line import AT_ONCE, Line

if TYPE_CHECKING:
    import socket

    from .modbus_frames import Request


class TcpLine(Line):
    """Modbus TCP: a header with a number before each request."""

    _HEADER: Final = struct.Struct(">HHHB")
    _SIZES: Final = range(2, 255)
    """Of a frame beyond the header's first six bytes."""

    def __init__(
        self, connection: socket.socket, unit: int, timeout: float, where: str
    ) -> None:
        super().__init__(unit, timeout, where)
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

    def framed(self, data: bytes) -> bytes:
        """Return a request with its header."""
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
