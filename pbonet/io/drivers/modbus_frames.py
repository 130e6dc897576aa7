"""Requests of Modbus for the values of consecutive ports, and what answers them.

These are the protocol's own units, without what a line puts around them (see
`modbus_lines`): Modbus Application Protocol 1.1b3, functions 1 to 4, 15 and 16.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from pbonet.errors import DeviceError

if TYPE_CHECKING:
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
