"""One file of a run: its channels, and the messages of selected channels.

A finished file has an index at its end, so that opening it reads neither cycles nor
events. In a truncated file, each chunk is read.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np

from pbonet.errors import LogError

from . import scan
from .records import ATTACHED, FORMAT, METADATA, Attached, RunAbout
from .rows import Rows, gathered

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
_CHUNK_HEAD: Final = struct.Struct("<QQQ")
_PLACES: Final = np.dtype([("channel", "<u2"), ("at", "<u8")])
_ENTRIES: Final = np.dtype([("time", "<u8"), ("at", "<u8")])
_WHERE: Final = struct.Struct("<QQ")
_ENTRY: Final = _ENTRIES.itemsize


class Schema(NamedTuple):
    """Schema of a channel's messages."""

    name: str
    encoding: str
    data: bytes


_NONE: Final = Schema("", "", b"")


class Source(NamedTuple):
    """One of the files that were merged into a file."""

    about: RunAbout
    attached: dict[str, str]
    """Current names of its attachments, by original name; if missing, unchanged."""


class Channel(NamedTuple):
    """One channel of a file."""

    topic: str
    encoding: str
    schema: Schema
    metadata: dict[str, str]


class _Chunk:
    """A group of messages, compressed together.

    Args:
        at: Offset of the content of its record.
        size: Size of the content.
        first_ns: The least time of a message.
        last_ns: The greatest time of a message.
    """

    __slots__ = ("at", "base", "first_ns", "index", "last_ns", "own", "size")

    def __init__(self, at: int, size: int, first_ns: int, last_ns: int) -> None:
        self.at, self.size = at, size
        self.first_ns, self.last_ns = first_ns, last_ns
        self.base = 0
        """Offset of its first byte among the uncompressed chunks of the file."""
        self.index: dict[int, int] = {}
        """Offset of the file's list of a channel's messages, by channel."""
        self.own: dict[int, list[int]] = {}
        """Offsets in the chunk of messages that the file does not list, by channel."""


class Part:
    """One file of a run.

    Args:
        path: The file.

    Raises:
        LogError: It is not a log, or of a newer version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.count = 0
        """Number of messages."""
        self.metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Schema] = {}
        self._chunks: list[_Chunk] = []
        self._sound: dict[int, bool] = {}
        self._attachments: list[tuple[int, int]] = []
        self._rows: dict[int, Rows] = {}
        with scan.open_log(path) as file:
            self.size = file.seek(0, 2)
            summary = scan.summary(file, str(path))
            self.complete = summary is not None
            """Whether the file was finished."""
            if summary is not None:
                self._take_summary(file, summary)
            else:
                self._take_scan(file, scan.scan(file, str(path)))
        self.sources = list(_sources(self.metadata, path))
        """The files that were merged into it; if it was not merged, itself."""
        self.about = self.sources[0].about if METADATA in self.metadata else None

    # -- opening -----------------------------------------------------------------------

    def _take_summary(self, file: BinaryIO, data: memoryview) -> None:
        base = 0
        for opcode, at, size in scan.inside(data):
            content = data[at : at + size]
            if opcode in {scan.SCHEMA, scan.CHANNEL}:
                self._define(opcode, content)
            elif opcode == scan.CHUNK_INDEX:
                base += self._add_indexed(content, base)
            elif opcode == scan.STATISTICS:
                self.count = int.from_bytes(content[:8], "little")
            elif opcode == scan.ATTACHMENT_INDEX:
                where, length = _WHERE.unpack_from(content)
                self._attachments.append((where + scan.HEAD, length - scan.HEAD))
            elif opcode == scan.METADATA_INDEX:
                where, length = _WHERE.unpack_from(content)
                self._tell(_read(file, where + scan.HEAD, length - scan.HEAD))
        for chunk in self._chunks:
            if not chunk.index:  # from another program
                self._learn(file, chunk)

    def _add_indexed(self, content: memoryview, base: int) -> int:
        """Add a chunk; return its uncompressed size."""
        first, last, where, length, size = _CHUNK_INDEX.unpack_from(content)
        at = _CHUNK_INDEX.size
        chunk = _Chunk(where + scan.HEAD, length - scan.HEAD, first, last)
        places = np.frombuffer(content[at : at + size], _PLACES)
        names, wheres = places["channel"].tolist(), places["at"].tolist()
        chunk.index = dict(zip(names, wheres, strict=True))
        chunk.base = base
        self._chunks.append(chunk)
        return int.from_bytes(content[-8:], "little")

    def _take_scan(self, file: BinaryIO, content: scan.Content) -> None:
        base = 0
        for opcode, at, size in content.records:
            if opcode == scan.CHUNK:
                head = _CHUNK_HEAD.unpack(_read(file, at, _CHUNK_HEAD.size))
                chunk = _Chunk(at, size, head[0], head[1])
                chunk.base = base
                base += head[2]
                self._chunks.append(chunk)
            elif opcode == scan.MESSAGE_INDEX and self._chunks:
                (channel,) = struct.unpack("<H", _read(file, at, 2))
                self._chunks[-1].index[channel] = at - scan.HEAD
            elif opcode in {scan.SCHEMA, scan.CHANNEL}:  # perhaps without messages
                self._define(opcode, memoryview(_read(file, at, size)))
            elif opcode == scan.ATTACHMENT:
                self._attachments.append((at, size))
            elif opcode == scan.METADATA:
                self._tell(_read(file, at, size))
        for chunk in self._chunks:
            self._learn(file, chunk)

    def _learn(self, file: BinaryIO, chunk: _Chunk) -> None:
        """Find the channels and messages of a chunk that the file does not list."""
        data = self._unpacked(file, chunk)
        if data is None:
            return
        each = [self._places(file, chunk, key) for key in chunk.index]
        listed = np.sort(np.concatenate([*each, np.zeros(0, np.int64)]))
        self.count += len(listed)
        sizes = gathered(data, listed + 1, "<u8").astype(np.int64)
        begins = np.concatenate([[0], listed + scan.HEAD + sizes])
        ends = np.concatenate([listed, [len(data)]])
        for gap in np.flatnonzero(ends > begins):
            begin = int(begins[gap])
            for opcode, at, size in scan.inside(data[begin : int(ends[gap])]):
                content = data[begin + at : begin + at + size]
                if opcode == scan.MESSAGE:
                    place = begin + at - scan.HEAD
                    chunk.own.setdefault(scan.message(content), []).append(place)
                    self.count += 1
                elif opcode in {scan.SCHEMA, scan.CHANNEL}:
                    self._define(opcode, content)

    def _define(self, opcode: int, content: memoryview) -> None:
        """Add a schema or a channel."""
        number = int.from_bytes(content[:2], "little")
        if opcode == scan.SCHEMA:
            (name, encoding), at = _texts(content, 2, 2)
            size = int.from_bytes(content[at : at + 4], "little")
            data = bytes(content[at + 4 : at + 4 + size])
            self._schemas[number] = Schema(name, encoding, data)
            return
        schema = int.from_bytes(content[2:4], "little")
        (topic, encoding), at = _texts(content, 4, 2)
        self.channels[number] = Channel(
            topic, encoding, self._schemas.get(schema, _NONE), _map(content, at)
        )

    def _tell(self, content: bytes) -> None:
        data = memoryview(content)
        (name,), at = _texts(data, 0, 1)
        self.metadata[name] = _map(data, at)

    # -- content -----------------------------------------------------------------------

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return len(self._chunks)

    @property
    def damaged(self) -> int:
        """Number of chunks that cannot be decompressed; unread ones are checked now."""
        with scan.open_log(self.path) as file:
            for chunk in self._chunks:
                if chunk.at not in self._sound:
                    self._unpacked(file, chunk)
        return sum(not sound for sound in self._sound.values())

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The least and the greatest time of a message; None if there are none."""
        if not self._chunks:
            return None
        firsts = [chunk.first_ns for chunk in self._chunks]
        return min(firsts), max(chunk.last_ns for chunk in self._chunks)

    @property
    def attached(self) -> dict[str, Attached]:
        """The attached files, by name."""
        with scan.open_log(self.path) as file:
            each = [_attachment(_read(file, *where)) for where in self._attachments]
        return {one.name: one for one in each}

    def load(self, keys: Iterable[int] | None = None) -> None:
        """Read the messages of some channels, or all, in one pass through the file."""
        every = self.channels if keys is None else keys
        wanted = [key for key in every if key not in self._rows]
        if not wanted:
            return
        found: dict[int, list[Rows]] = {key: [] for key in wanted}
        with scan.open_log(self.path) as file:
            for chunk in self._chunks:
                there = [k for k in wanted if k in chunk.index or k in chunk.own]
                data = self._unpacked(file, chunk) if there else None
                if data is not None:
                    for key in there:
                        places = self._places(file, chunk, key)
                        found[key].append(Rows.of(data, places, chunk.base))
        self._rows |= {key: Rows.joined(each) for key, each in found.items()}

    def rows(self, key: int) -> Rows:
        """Return the messages of a channel, in the order of the file."""
        self.load([key])
        return self._rows[key]

    def _unpacked(self, file: BinaryIO, chunk: _Chunk) -> memoryview | None:
        """Return the content of a chunk; None if it is damaged."""
        data = scan.unpacked(_read(file, chunk.at, chunk.size))
        self._sound[chunk.at] = data is not None
        return data

    @staticmethod
    def _places(file: BinaryIO, chunk: _Chunk, key: int) -> NDArray[np.int64]:
        """Return the offsets of a channel's messages in a chunk, ascending."""
        own = np.array(chunk.own.get(key, []), np.int64)
        if key not in chunk.index:
            return own
        at = chunk.index[key] + scan.HEAD
        (size,) = struct.unpack("<I", _read(file, at + 2, 4))
        entries = np.frombuffer(_read(file, at + 6, size // _ENTRY * _ENTRY), _ENTRIES)
        return np.sort(np.concatenate([own, entries["at"].astype(np.int64)]))


def _sources(metadata: dict[str, dict[str, str]], path: Path) -> Iterator[Source]:
    """Yield a file's description of itself, or of the files that were merged.

    Raises:
        LogError: It was written by a newer pbonet.
    """
    number, name = 1, METADATA
    while name in metadata:
        told = metadata[name].get(ATTACHED, "{}")
        names = msgspec.json.decode(told, type=dict[str, str])
        yield Source(_run_about(metadata[name], path), names)
        number += 1
        name = f"{METADATA} {number}"


def _run_about(values: dict[str, str], path: Path) -> RunAbout:
    """Return the run of a file.

    Raises:
        LogError: It was written by a newer pbonet.
    """
    version = values.get("format", str(FORMAT))
    if version.isdecimal() and int(version) > FORMAT:
        raise LogError(
            "the log was written by a newer pbonet",
            where=str(path),
            expected=f"format {FORMAT} or older",
            got=f"format {version}, pbonet {values.get('pbonet', '?')}",
            remedy="install that version; other tools read the file as it is",
        )
    return msgspec.convert(values, RunAbout, strict=False)


def _read(file: Any, at: int, size: int) -> bytes:  # noqa: ANN401 - a file
    file.seek(at)
    return cast("bytes", file.read(size))


def _texts(data: memoryview, at: int, count: int) -> tuple[list[str], int]:
    """Return texts with their lengths before them, and the offset after them."""
    texts: list[str] = []
    for _ in range(count):
        size = int.from_bytes(data[at : at + 4], "little")
        texts.append(bytes(data[at + 4 : at + 4 + size]).decode(errors="replace"))
        at += 4 + size
    return texts, at


def _map(data: memoryview, at: int) -> dict[str, str]:
    end = at + 4 + int.from_bytes(data[at : at + 4], "little")
    at += 4
    found: dict[str, str] = {}
    while at < end:
        (key, value), at = _texts(data, at, 2)
        found[key] = value
    return found


def _attachment(content: bytes) -> Attached:
    data = memoryview(content)
    (name, kind), at = _texts(data, 16, 2)
    size = int.from_bytes(data[at : at + 8], "little")
    return Attached(name, bytes(data[at + 8 : at + 8 + size]), kind)
