"""The records of an MCAP file: from its summary, or one by one without it.

A file that was truncated, or is still being written, ends at its last whole record.
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
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 2, 3, 4, 5, 6, 7
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS = 8, 9, 10, 11
METADATA, METADATA_INDEX = 12, 13
_HEAD: Final = struct.Struct("<BQ")
HEAD: Final = _HEAD.size
"""Bytes before the content of a record."""
MESSAGE_HEAD: Final = struct.calcsize("<HIQQ")
"""Bytes before the data of a message, in its content."""
_CHUNK: Final = struct.Struct("<QQQII")
_FOOTER: Final = struct.Struct("<QQI")
_LARGEST: Final = 1 << 31


class Found(NamedTuple):
    """A record outside of chunks: its type, and offset and size of its content."""

    opcode: int
    at: int
    size: int


class Content(NamedTuple):
    """The result of `scan`."""

    records: list[Found]
    end: int
    """Offset of the end of the last whole record."""
    complete: bool
    """Whether the file was finished."""


def summary(file: BinaryIO, where: str) -> memoryview | None:
    """Return the records at the end of a finished file, which index the rest.

    Returns:
        None for a file that was truncated, or has no such records.

    Raises:
        LogError: It is not an MCAP file.
    """
    size = _size(file, where)
    last = HEAD + _FOOTER.size + len(MAGIC)
    if size < len(MAGIC) + last or not _ends_well(file, size):
        return None
    file.seek(size - last)
    opcode, _ = _HEAD.unpack(file.read(HEAD))
    start, _, crc = _FOOTER.unpack(file.read(_FOOTER.size))
    if opcode != FOOTER or not len(MAGIC) <= start < size - last:
        return None
    file.seek(start)
    data = file.read(size - last - start + HEAD + _FOOTER.size - 4)
    if crc and zlib.crc32(data) != crc:
        return None
    return memoryview(data)[: size - last - start]


def scan(file: BinaryIO, where: str) -> Content:
    """Return the whole records of a file.

    Raises:
        LogError: It is not an MCAP file.
    """
    size = _size(file, where)
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


def _size(file: BinaryIO, where: str) -> int:
    """Return the size of a file that begins correctly, even if it is very short.

    Raises:
        LogError: It is not an MCAP file.
    """
    size = file.seek(0, 2)
    file.seek(0)
    if not MAGIC.startswith(file.read(len(MAGIC))):
        raise LogError(
            "this is not a log",
            where=where,
            expected="an MCAP file",
            got=f"{size} bytes of something else",
            remedy="name a run.mcap, or the folder of a run",
        )
    return size


def _ends_well(file: BinaryIO, size: int) -> bool:
    file.seek(size - len(MAGIC))
    return file.read(len(MAGIC)) == MAGIC


def unpacked(content: bytes) -> memoryview | None:
    """Return the records in a chunk; None if it is damaged."""
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


def message(content: memoryview) -> int:
    """Return the channel number of a message."""
    return int.from_bytes(content[:2], "little")


def is_complete(path: Path) -> bool:
    """Return whether there is a finished log at a path."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            return size > 2 * len(MAGIC) and _ends_well(file, size)
    except OSError:
        return False


def open_log(path: Path) -> BinaryIO:
    """Open a log for reading.

    Raises:
        LogError: It cannot be read.
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
