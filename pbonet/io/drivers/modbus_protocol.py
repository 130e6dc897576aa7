"""Modbus: requests for the values of consecutive ports, what answers them, and lines.

The protocol's own units are those of the Modbus Application Protocol 1.1b3, functions 1
to 4, 15 and 16. A line puts a header around them (a connection, TCP), or a checksum
(a serial line, RTU).
"""

from __future__ import annotations

import errno
import struct
from itertools import count
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from pbonet.errors import DeviceError

from . import inet_sockets
from .request_device import AT_ONCE, Line
from .shared_serial_line import SharedLine

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterator, Sequence

TableName = Literal["holding", "input", "coils", "discrete"]


class Table(NamedTuple):
    """One of the four tables of a device."""

    bits: int
    """Of a port."""
    read: int
    """The function that reads it."""
    most: int
    """How many ports one request reads."""
    write: int
    """The function that writes it; 0: it cannot be written."""
    most_written: int


TABLES: Final[dict[str, Table]] = {
    "coils": Table(1, 1, 2000, 15, 1968),
    "discrete": Table(1, 2, 2000, 0, 0),
    "holding": Table(16, 3, 125, 16, 123),
    "input": Table(16, 4, 125, 0, 0),
}
EXCEPTIONS: Final = {
    1: "it has no such function",
    2: "it has no such address in this table",
    3: "it does not take this value, or this number of values",
    4: "it has failed",
    5: "it has taken the request, and needs long",
    6: "it is busy",
    8: "its memory has an error of parity",
    10: "the gateway has no way to it",
    11: "it does not answer the gateway",
}
"""A device's reasons to refuse a request, by code."""
REFUSED: Final = 0x80
"""The bit that the function of a refusal has."""
REFUSAL: Final = 2
"""Bytes of a refusal: the function, and the code."""
_HEAD: Final = struct.Struct(">BHH")


class Request(NamedTuple):
    """A request for consecutive ports."""

    data: bytes
    ports: int
    begin: bytes
    """The first bytes of its answer, unless that is a refusal."""
    size: int
    """Bytes of that answer."""

    @property
    def function(self) -> int:
        """The function."""
        return self.data[0]


def reads(table: Table, first: int, count: int) -> Iterator[Request]:
    """Yield the requests that read so many ports."""
    for at, n in _parts(first, count, table.most):
        size = (n * table.bits + 7) // 8
        data = _HEAD.pack(table.read, at, n)
        yield Request(data, n, bytes((table.read, size)), 2 + size)


def writes(table: Table, first: int, values: Sequence[int]) -> Iterator[Request]:
    """Yield the requests that write these values."""
    for at, n in _parts(first, len(values), table.most_written):
        some = values[at - first : at - first + n]
        if table.bits == 1:
            number = sum(value << k for k, value in enumerate(some))
            data = number.to_bytes((n + 7) // 8, "little")
        else:
            data = struct.pack(f">{n}H", *some)
        head = _HEAD.pack(table.write, at, n)
        yield Request(head + bytes((len(data),)) + data, n, head, len(head))


def check(request: Request, answer: bytes, where: str) -> None:
    """Return if a device did what it was asked for.

    Raises:
        DeviceError: It refuses, or answers something else.
    """
    if len(answer) == REFUSAL and answer[0] == request.function | REFUSED:
        code = answer[1]
        raise DeviceError(
            "the device refuses the request",
            where=where,
            got=f"{EXCEPTIONS.get(code, 'for a reason of its own')} (code {code})",
            remedy="check unit, table, first and the number of ports in agent.toml",
        )
    if len(answer) != request.size or not answer.startswith(request.begin):
        raise no_answer_to_this(where, answer)


def values_of(table: Table, answers: Sequence[tuple[Request, bytes]]) -> list[int]:
    """Return the values that the answers to `reads` have."""
    found: list[int] = []
    for request, answer in answers:
        if table.bits == 1:
            number = int.from_bytes(answer[2:], "little")
            found += [number >> k & 1 for k in range(request.ports)]
        else:
            found += struct.unpack_from(f">{request.ports}H", answer, 2)
    return found


def no_answer_to_this(where: str, got: bytes) -> DeviceError:
    """Return the error for bytes that do not answer the request."""
    return DeviceError(
        "the device's answer does not fit the request",
        where=where,
        expected="an answer of Modbus to it",
        got=got[:16].hex(" ") or "nothing",
        remedy="check that it talks Modbus, the line's settings, and its wires",
    )


def _parts(first: int, count: int, most: int) -> Iterator[tuple[int, int]]:
    """Yield the first port and the number of ports of each request."""
    for at in range(first, first + count, most):
        yield at, min(most, first + count - at)


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
