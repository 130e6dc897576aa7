"""The records of an MCAP file: from its summary, or one by one without it.

A file that was truncated, or is still being written, ends at its last whole record.
Where a file is damaged, the next chunk is searched for.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from pbonet.errors import LogError

from ._walk import walk

if TYPE_CHECKING:
    from typing import BinaryIO

    from numpy.typing import NDArray

MAGIC: Final = bytes((137, 77, 67, 65, 80, 48, 13, 10))
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 2, 3, 4, 5, 6, 7
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS = 8, 9, 10, 11
METADATA, METADATA_INDEX, DATA_END = 12, 13, 15
HEADER: Final = 1
_HEAD: Final = struct.Struct("<BQ")
HEAD: Final = _HEAD.size
"""Bytes before the content of a record."""
MESSAGE_HEAD: Final = struct.calcsize("<HIQQ")
"""Bytes before the data of a message, in its content."""
TIME_AT: Final = struct.calcsize("<HI")
"""Offset of a message's time in its content."""
_CHUNK: Final = struct.Struct("<QQQII")
_FOOTER: Final = struct.Struct("<QQI")


class Found(NamedTuple):
    """A record outside of chunks: its type, and offset and size of its content."""

    opcode: int
    at: int
    size: int


class Content(NamedTuple):
    """The result of `scan`."""

    records: list[Found]
    """Records of type `LOST` are damaged regions."""
    end: int | None
    """Offset of the end of the data, where the index begins; None: the file was not
    finished."""


LOST: Final = 0
"""The type of a region in which no record was found."""
_ZSTD: Final = b"\x04\x00\x00\x00zstd"
_OURS: Final = b"\x06\x00\x00\x00pbonet"
"""How a description of the run begins."""
_BEFORE_ZSTD: Final = HEAD + _CHUNK.size - 4
"""Bytes of a chunk's record before the name of its compression."""


def summary(file: BinaryIO, where: str) -> bytes | None:
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
    return data[: size - last - start]


def scan(file: BinaryIO, where: str) -> Content:
    """Return the records of a file up to its index, one after the other.

    Raises:
        LogError: It is not an MCAP file.
    """
    size = _size(file, where)
    at, found = len(MAGIC), list[Found]()
    while at < size:
        one = _record(file, at, size)
        if one is None:
            begin, at = at, _next_sound(file, at + 1)
            if at < size or not _is_truncated(file, begin, size):
                found.append(Found(LOST, begin, at - begin))
            continue
        if one.opcode == DATA_END:
            return Content(found, one.at + one.size if _ends_well(file, size) else None)
        found.append(one)
        at = one.at + one.size
    return Content(found, None)


def _record(file: BinaryIO, at: int, size: int) -> Found | None:
    """Return the record at an offset; None if there is none that pbonet writes there.

    Chunks and attachments have checksums, and the content of the others is not used.
    """
    file.seek(at)
    head = file.read(HEAD)
    if len(head) < HEAD:
        return None
    opcode, length = _HEAD.unpack(head)
    if length > size - at - HEAD or opcode not in _LEAST:
        return None
    least, most = _LEAST[opcode]
    if not least <= length <= most:
        return None
    if opcode == MESSAGE_INDEX:
        _, entries = struct.unpack("<HI", file.read(6))
        if entries != length - 6:
            return None
    return Found(opcode, at + HEAD, length)


_LARGEST: Final = 1 << 31
_LEAST: Final = {
    HEADER: (8, 1 << 16),
    CHUNK: (_CHUNK.size + 8, _LARGEST),
    MESSAGE_INDEX: (6, _LARGEST),
    ATTACHMENT: (36, _LARGEST),
    METADATA: (8, 1 << 24),
    DATA_END: (4, 4),
}
"""The least and the greatest size of records between the beginning and the index."""


def _next_sound(file: BinaryIO, at: int) -> int:
    """Return the offset of the next chunk or description of the run.

    Returns:
        The file's size if there is none that is whole.
    """
    file.seek(at)
    data = file.read()
    place = -1
    while True:
        places = (data.find(_ZSTD, place + 1), data.find(_OURS, place + 1))
        place = min((one for one in places if one >= 0), default=-1)
        if place < 0:
            return at + len(data)
        begin = place - (_BEFORE_ZSTD if place == places[0] else HEAD)
        if begin >= 0 and _is_sound(data, begin):
            return at + begin


def _is_sound(data: bytes, at: int) -> bool:
    """Return whether a whole chunk or description begins at an offset."""
    opcode, length = _HEAD.unpack_from(data, at)
    content = data[at + HEAD : at + HEAD + length]
    if opcode == CHUNK:
        return unpacked(content) is not None
    return bool(opcode == METADATA and len(content) == length)


def _is_truncated(file: BinaryIO, at: int, size: int) -> bool:
    """Return whether the rest of a file is the beginning of one record."""
    file.seek(at)
    head = file.read(HEAD)
    if len(head) < HEAD:
        return True
    opcode, length = _HEAD.unpack(head)
    return opcode in _LEAST and size - at - HEAD < length <= _LEAST[opcode][1]


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


def unpacked(content: bytes) -> bytes | None:
    """Return the records in a chunk; None if it is damaged."""
    import zstandard

    try:
        _, _, size, crc, name_size = _CHUNK.unpack_from(content)
        at = _CHUNK.size
        name = content[at : at + name_size].decode()
        at += name_size
        (packed,) = struct.unpack_from("<Q", content, at)
        at += 8
        data = content[at : at + packed]
        if name == "zstd" and zstandard.frame_content_size(data) == size < _LARGEST:
            data = zstandard.ZstdDecompressor().decompress(data)
        elif name:
            return None
    except (struct.error, ValueError, zstandard.ZstdError):
        return None
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        return None
    return data


def records(data: bytes) -> NDArray[np.int64] | None:
    """Return the records in a chunk or in a summary.

    Returns:
        A row for each: type, channel of a message, offset and size of its content;
        shape ``(n, 4)``. None if a record does not fit.
    """
    rows = walk(data)
    return None if rows is None else np.frombuffer(rows, np.int64).reshape(-1, 4)


def attachment(content: bytes) -> bytes | None:
    """Return an attachment without its checksum; None if it is damaged."""
    crc = int.from_bytes(content[-4:], "little")
    if crc and zlib.crc32(content[:-4]) != crc:
        return None
    return content[:-4]


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
