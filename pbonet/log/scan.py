"""Which records an MCAP file holds whole, found without its summary.

A file that was cut anywhere, or is still being written, ends at its last whole record.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from pbonet.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import BinaryIO

MAGIC: Final = bytes((137, 77, 67, 65, 80, 48, 13, 10))
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
ATTACHMENT, METADATA, DATA_END, FOOTER = 9, 12, 15, 2
_HEAD: Final = struct.Struct("<BQ")
_CHUNK: Final = struct.Struct("<QQQII")
_MESSAGE: Final = struct.Struct("<HIQQ")
_LARGEST: Final = 1 << 31


class Found(NamedTuple):
    """A record outside of chunks: what it is, and where its content stands."""

    opcode: int
    at: int
    size: int


class Content(NamedTuple):
    """What `scan` found."""

    records: list[Found]
    end: int
    """Bytes up to the end of the last whole record."""
    complete: bool
    """Whether the file was finished."""


def scan(file: BinaryIO, where: str) -> Content:
    """Return the whole records of a file.

    Raises:
        LogError: It is no MCAP file.
    """
    size = file.seek(0, 2)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError(
            "this is no log",
            where=where,
            expected="an MCAP file",
            got=f"{size} bytes of something else" if size else "an empty file",
            remedy="name a run.mcap, or the folder of a run",
        )
    at, found = len(MAGIC), list[Found]()
    while True:
        file.seek(at)
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return Content(found, at, complete=False)
        opcode, length = _HEAD.unpack(head)
        if length > _LARGEST or at + _HEAD.size + length > size or not opcode:
            return Content(found, at, complete=False)
        found.append(Found(opcode, at + _HEAD.size, length))
        at += _HEAD.size + length
        if opcode == FOOTER:
            return Content(found, at, complete=_ends_well(file, size))


def _ends_well(file: BinaryIO, size: int) -> bool:
    file.seek(size - len(MAGIC))
    return file.read(len(MAGIC)) == MAGIC


def unpacked(content: bytes) -> memoryview | None:
    """Return the records in a chunk; None when it is damaged."""
    import zstandard

    try:
        _, _, size, crc, name_size = _CHUNK.unpack_from(content)
        at = _CHUNK.size
        name = content[at : at + name_size].decode()
        at += name_size
        (packed,) = struct.unpack_from("<Q", content, at)
        at += 8
        data: bytes | memoryview = memoryview(content)[at : at + packed]
        if name == "zstd":
            data = zstandard.ZstdDecompressor().decompress(data, size)
        elif name:
            return None
    except (struct.error, ValueError, zstandard.ZstdError):
        return None
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        return None
    return memoryview(data)


def inside(chunk: memoryview) -> Iterator[Found]:
    """Yield the records in a chunk."""
    at, size = 0, len(chunk)
    while at + _HEAD.size <= size:
        opcode, length = _HEAD.unpack_from(chunk, at)
        at += _HEAD.size
        yield Found(opcode, at, length)
        at += length


def message(data: memoryview, at: int) -> tuple[int, int, int]:
    """Return channel, log time and publish time of a message."""
    channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, at)
    return channel, log_ns, publish_ns


MESSAGE_HEAD: Final = _MESSAGE.size


def is_complete(path: Path) -> bool:
    """Tell whether a log stands there that was finished."""
    try:
        with path.open("rb") as file:
            return _ends_well(file, file.seek(0, 2))
    except OSError:
        return False


def open_log(path: Path) -> BinaryIO:
    """Open a log for reading.

    Raises:
        LogError: There is none.
    """
    try:
        return path.open("rb")
    except OSError as error:
        raise LogError(
            "the log cannot be read",
            where=str(path),
            got=error.strerror or str(error),
            remedy="name a run.mcap, or the folder of a run",
        ) from None
