"""Batches of commands and their results, as bytes.

A batch is what one WAKEUP ends (Stewart 1994, section 7.4.2): a number, and commands in
the order in which they are carried out. Its result has what was transferred back.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from pbonet.errors import PbonetError, SppError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from pbonet.errors import WireError

    from .kernel_library import Variable

WRITE: Final = 1
CALL: Final = 2
READ: Final = 3
_HEAD: Final = struct.Struct("<QQ")
"""Number of the batch, and count of its commands."""
_COMMAND: Final = struct.Struct("<BxHI")
"""Kind, index of the variable or routine, and bytes that follow."""
_INTEGER, _FLOAT, _TRUTH = 0, 1, 2
_ARGUMENT_INTEGER: Final = struct.Struct("<Q q")
_ARGUMENT_FLOAT: Final = struct.Struct("<Q d")
_RESULT: Final = struct.Struct("<QQqII")
"""Number, starts of the executive, stamp, bytes of the error, count of values."""
_VALUE: Final = struct.Struct("<II")
"""Index of the variable, and bytes that follow."""
_GOT, _PART = 1500, 400
"""Bytes of an error's `got`, and of each of its other parts."""
_PLACES: Final = 64
_OTHERS: Final = 4096
"""Bytes of a batch for calls."""


def room_of_batch(variables: Sequence[Variable]) -> int:
    """Return the greatest size of a batch: each variable written twice, and calls."""
    return _OTHERS + 2 * sum(_padded(one.size) + _COMMAND.size for one in variables)


def room_of_result(variables: Sequence[Variable]) -> int:
    """Return the greatest size of a result."""
    return _OTHERS + sum(_padded(one.size) + _VALUE.size for one in variables)


def _padded(size: int) -> int:
    return -(-size // 8) * 8


class Batch:
    """The batch that a client fills; its memory is reserved once.

    Args:
        room: Bytes that it can have.
        name: The processor's, for messages.
    """

    def __init__(self, room: int, name: str) -> None:
        self._bytes = bytearray(room)
        self._view = memoryview(self._bytes)
        self._at = _HEAD.size
        self._count = 0
        self._name = name
        self._places: dict[tuple[int, int], NDArray[Any]] = {}
        """Arrays in the batch where variables were written before."""

    def write(self, index: int, variable: Variable, values: NDArray[Any]) -> None:
        """Add a transfer to a variable; the values, of its shape, are copied now."""
        at = self._command(WRITE, index, variable.size)
        place = self._places.get((at, index))
        if place is None:
            place = np.ndarray(variable.shape, variable.dtype, self._bytes, at)
            if len(self._places) == _PLACES:
                self._places.clear()
            self._places[at, index] = place
        place[...] = values

    def read(self, index: int) -> None:
        """Add a transfer back from a variable."""
        self._command(READ, index, 0)

    def call(self, index: int, arguments: Sequence[float | int]) -> None:
        """Add a call of a routine."""
        begin, count = self._at, self._count
        at = self._command(CALL, index, _ARGUMENT_FLOAT.size * len(arguments))
        for one in arguments:
            try:
                self._argument(at, one)
            except (struct.error, OverflowError):
                self._at, self._count = begin, count  # no call with other numbers
                raise SppError(
                    "an argument of a call cannot be passed",
                    where=self._name,
                    expected="a number of 64 bits",
                    got=f"{type(one).__name__} {one!r:.40}",
                    remedy="convert it, or write it to a variable",
                ) from None
            at += _ARGUMENT_FLOAT.size

    def _argument(self, at: int, value: object) -> None:
        if isinstance(value, (float, np.floating)):
            _ARGUMENT_FLOAT.pack_into(self._bytes, at, _FLOAT, value)
        elif isinstance(value, (bool, np.bool_)):
            _ARGUMENT_INTEGER.pack_into(self._bytes, at, _TRUTH, 1 if value else 0)
        else:
            _ARGUMENT_INTEGER.pack_into(self._bytes, at, _INTEGER, value)

    def _command(self, kind: int, index: int, size: int) -> int:
        """Add a command; return where its bytes go."""
        at = self._at + _COMMAND.size
        if at + size > len(self._bytes):
            raise SppError(
                "the batch is too long",
                where=self._name,
                expected=f"at most {len(self._bytes)} bytes",
                got=f"{at + size}",
                remedy="end it with wait() before, or write each variable once",
            )
        _COMMAND.pack_into(self._bytes, self._at, kind, index, size)
        self._at = at + _padded(size)
        self._count += 1
        return at

    def end(self, number: int) -> memoryview:
        """Return the whole batch, and begin another one in its place."""
        _HEAD.pack_into(self._bytes, 0, number, self._count)
        whole = self._view[: self._at]
        self.clear()
        return whole

    @property
    def is_empty(self) -> bool:
        """Whether it has no commands."""
        return not self._count

    def clear(self) -> None:
        """Forget the commands."""
        self._at, self._count = _HEAD.size, 0


class Command(NamedTuple):
    """A command of a batch."""

    kind: int
    which: int
    """Index of the variable or routine."""
    data: memoryview


def number_of(batch: bytes | memoryview) -> int:
    """Return the number of a batch."""
    return int(_HEAD.unpack_from(batch)[0])


def commands(batch: bytes | memoryview) -> Iterator[Command]:
    """Yield the commands of a batch in their order."""
    view, at = memoryview(batch), _HEAD.size
    for _ in range(_HEAD.unpack_from(batch)[1]):
        kind, index, size = _COMMAND.unpack_from(batch, at)
        at += _COMMAND.size
        yield Command(kind, index, view[at : at + size])
        at += _padded(size)


def arguments(data: memoryview) -> list[float]:
    """Return the numbers of a call."""
    found: list[float] = []
    for at in range(0, len(data), _ARGUMENT_FLOAT.size):
        kind, value = _ARGUMENT_INTEGER.unpack_from(data, at)
        if kind == _FLOAT:
            value = _ARGUMENT_FLOAT.unpack_from(data, at)[1]
        found.append(bool(value) if kind == _TRUTH else value)
    return found


class Result(NamedTuple):
    """Outcome of a batch."""

    number: int
    """The batch's; all before it are done, too."""
    starts: int
    """How often the executive was started."""
    stamp_ns: int
    """When it was done; 0: it was not done, as the executive was started again."""
    error: PbonetError | None
    values: list[tuple[int, memoryview]]
    """Indices of variables, and their bytes."""


def pack_result(
    number: int,
    starts: int,
    stamp_ns: int,
    values: Sequence[tuple[int, bytes]] = (),
    error: PbonetError | None = None,
) -> bytes:
    """Return a result as bytes."""
    text = msgspec.msgpack.encode(short_wire(error)) if error else b""
    parts: list[bytes] = [
        _RESULT.pack(number, starts, stamp_ns, len(text), len(values)),
        text.ljust(_padded(len(text)), b"\0"),
    ]
    for index, data in values:
        parts.append(_VALUE.pack(index, len(data)))
        parts.append(data.ljust(_padded(len(data)), b"\0"))
    return b"".join(parts)


def short_wire(error: PbonetError) -> dict[str, str]:
    """Return an error as plain data that a result has room for, and as valid text."""
    found: dict[str, str] = {}
    for key in ("code", "what", "where", "expected", "got", "remedy"):
        most = _GOT if key == "got" else _PART
        text = str(getattr(error, key)).encode(errors="backslashreplace")[:most]
        found[key] = text.decode(errors="ignore")
    return found


def unpack_result(data: bytes) -> Result:
    """Return a result."""
    number, starts, stamp_ns, size, count = _RESULT.unpack_from(data)
    at, view = _RESULT.size, memoryview(data)
    error: PbonetError | None = None
    if size:
        wire: WireError = msgspec.msgpack.decode(view[at : at + size])
        error = PbonetError.from_wire(wire)
    at += _padded(size)
    values: list[tuple[int, memoryview]] = []
    for _ in range(count):
        index, size = _VALUE.unpack_from(data, at)
        at += _VALUE.size
        values.append((index, view[at : at + size]))
        at += _padded(size)
    return Result(number, starts, stamp_ns, error, values)


def restamped(data: bytes, stamp_ns: int) -> bytes:
    """Return a result with another time, where it has one."""
    number, starts, then, size, count = _RESULT.unpack_from(data)
    head = _RESULT.pack(number, starts, stamp_ns if then else 0, size, count)
    return head + data[_RESULT.size :]
