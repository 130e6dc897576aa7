"""One file of a run: its channels, and the messages of selected channels.

A finished file has an index at its end, so that opening it reads neither cycles nor
events. In a truncated file, each chunk is read. Whatever is read has a checksum: what
does not fit it is left out and reported as damage.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np

from pbonet.errors import LogError

from . import scan
from .records import (
    ATTACHED,
    CHECKSUM,
    FORMAT,
    METADATA,
    SPAN_NS,
    Attached,
    RunAbout,
    checksum_of,
    is_ours,
)
from .rows import Rows, gathered

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

_CHUNK_INDEX: Final = struct.Struct("<QQQQI")
_PLACES: Final = np.dtype([("channel", "<u2"), ("at", "<u8")])
_WHERE: Final = struct.Struct("<QQ")
_TYPE, _CHANNEL, _AT, _SIZE = range(4)
"""Columns of `scan.records`."""


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


class Damage(NamedTuple):
    """A part of a file that cannot be read."""

    what: str
    """``chunk``, ``attachment``, ``description``, ``index``, or ``region``."""
    at: int
    """Its offset in the file."""
    size: int
    """Its size in bytes."""
    begin_ns: int | None
    """The time of the first message that may be missing, in nanoseconds since 1970;
    None: none is missing, or no message is known before it."""
    end_ns: int | None
    """The time of the last one; None: no message is known after it."""


class _Chunk:
    """A group of messages, compressed together.

    Args:
        at: Offset of the content of its record.
        size: Size of the content.
        lost: Whether it is a region in which no record was found.
    """

    __slots__ = (
        *("at", "base", "channels", "first_ns", "last_ns", "lost", "size", "sound"),
    )

    def __init__(self, at: int, size: int, *, lost: bool = False) -> None:
        self.at, self.size, self.lost = at, size, lost
        self.first_ns: int | None = None
        """The least time of a message; None: it has none, or it is not known."""
        self.last_ns: int | None = None
        """The greatest time of a message."""
        self.base = 0
        """Offset of its first byte among the uncompressed chunks of the file."""
        self.channels: Container[int] | None = None
        """Channels of its messages; None: not known."""
        self.sound: bool | None = None
        """Whether it has the right checksum; None: it was not read yet."""

    def may_have(self, keys: Iterable[int]) -> bool:
        """Return whether it can have a message of one of these channels."""
        return self.channels is None or any(key in self.channels for key in keys)


class Part:
    """One file of a run.

    Args:
        path: The file.

    Raises:
        LogError: It is not a log, or of a newer version, or its description is
            damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.count = 0
        """Number of messages."""
        self.metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Schema] = {}
        self._chunks: list[_Chunk] = []
        self._damage: list[Damage] = []
        """Damage outside of chunks."""
        self._attachments: list[tuple[int, int]] = []
        self._rows: dict[int, Rows] = {}
        with scan.open_log(path) as file:
            self.size = file.seek(0, 2)
            summary = scan.summary(file, str(path))
            self.complete = True
            """Whether the file was finished."""
            if summary is not None:
                self._take_summary(file, summary)
            else:
                content = scan.scan(file, str(path))
                self.complete = content.end is not None
                self._take_scan(file, content)
            self.attached = dict(self._attached(file))
            """The attached files, by name."""
        self.sources = list(_sources(self.metadata, path))
        """The files that were merged into it; if it was not merged, itself."""
        self.about = self.sources[0].about if METADATA in self.metadata else None
        if self.about is None:
            self._must_be_foreign()

    # -- opening -----------------------------------------------------------------------

    def _take_summary(self, file: BinaryIO, data: bytes) -> None:
        rows, base = scan.records(data), 0
        for opcode, _, at, size in () if rows is None else rows.tolist():
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
                self._describe(file, where + scan.HEAD, length - scan.HEAD)

    def _add_indexed(self, content: bytes, base: int) -> int:
        """Add a chunk; return its uncompressed size."""
        first, last, where, length, size = _CHUNK_INDEX.unpack_from(content)
        at = _CHUNK_INDEX.size
        chunk = _Chunk(where + scan.HEAD, length - scan.HEAD)
        chunk.first_ns, chunk.last_ns, chunk.base = first, last, base
        places = np.frombuffer(content[at : at + size], _PLACES)
        if size:  # other programs may leave it out
            chunk.channels = frozenset(places["channel"].tolist())
        self._chunks.append(chunk)
        return int.from_bytes(content[-8:], "little")

    def _take_scan(self, file: BinaryIO, content: scan.Content) -> None:
        for opcode, at, size in content.records:
            if opcode == scan.ATTACHMENT:
                self._attachments.append((at, size))
            elif opcode == scan.METADATA:
                self._describe(file, at, size)
            elif opcode in {scan.CHUNK, scan.LOST}:
                self._chunks.append(_Chunk(at, size, lost=opcode == scan.LOST))
        if content.end is not None:
            size = self.size - content.end
            self._damage.append(Damage("index", content.end, size, None, None))
        base = 0
        for chunk in self._chunks:
            chunk.base = base
            base += self._learn(file, chunk)

    def _learn(self, file: BinaryIO, chunk: _Chunk) -> int:
        """Find the channels and messages of a chunk; return its uncompressed size."""
        data, records = self._unpacked(file, chunk)
        kinds = records[:, _TYPE]
        messages = records[kinds == scan.MESSAGE]
        for opcode, _, at, size in records[kinds != scan.MESSAGE].tolist():
            if opcode in {scan.SCHEMA, scan.CHANNEL}:
                self._define(opcode, data[at : at + size])
        self.count += len(messages)
        if len(messages):
            times = gathered(data, messages[:, _AT] + scan.TIME_AT, "<u8")
            chunk.first_ns, chunk.last_ns = int(times.min()), int(times.max())
        if chunk.sound:
            chunk.channels = frozenset(messages[:, _CHANNEL].tolist())
        return max(len(data), 1)

    def _define(self, opcode: int, content: bytes) -> None:
        """Add a schema or a channel."""
        number = int.from_bytes(content[:2], "little")
        if opcode == scan.SCHEMA:
            (name, encoding), at = _texts(content, 2, 2)
            size = int.from_bytes(content[at : at + 4], "little")
            data = content[at + 4 : at + 4 + size]
            self._schemas[number] = Schema(name, encoding, data)
            return
        schema = int.from_bytes(content[2:4], "little")
        (topic, encoding), at = _texts(content, 4, 2)
        self.channels[number] = Channel(
            topic, encoding, self._schemas.get(schema, _NONE), _map(content, at)
        )

    def _describe(self, file: BinaryIO, at: int, size: int) -> None:
        """Add a metadata record; one of pbonet must have its checksum."""
        (name,), begin = _texts(content := _read(file, at, size), 0, 1)
        fields = _map(content, begin)
        checksum = fields.pop(CHECKSUM, "")
        if checksum == checksum_of(name, fields):
            self.metadata[name] = fields
            return
        if checksum or is_ours(name):
            self._damage.append(Damage("description", at, size, None, None))
        if not checksum:
            self.metadata.setdefault(name, fields)

    def _attached(self, file: BinaryIO) -> Iterator[tuple[str, Attached]]:
        for at, size in self._attachments:
            content = scan.attachment(_read(file, at, size))
            if content is None:
                self._damage.append(Damage("attachment", at, size, None, None))
            else:
                one = _attachment(content)
                yield one.name, one

    def _must_be_foreign(self) -> None:
        """Refuse a log of pbonet without a description: its times have no meaning.

        Raises:
            LogError: The description was there and is damaged.
        """
        regions = [
            Damage("region", c.at, c.size, None, None) for c in self._chunks if c.lost
        ]
        lost = [one for one in (*self._damage, *regions) if one.what != "attachment"]
        if lost:
            raise LogError(
                "the description of the run is damaged",
                where=f"{self.path}, byte {lost[0].at}",
                expected=f"one of the metadata records {METADATA} with its checksum",
                got="none",
                remedy="other MCAP tools show the messages, with raw times",
            )

    # -- content -----------------------------------------------------------------------

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return len(self._chunks)

    def check(self) -> None:
        """Check the chunks that were not read yet."""
        with scan.open_log(self.path) as file:
            for chunk in self._chunks:
                if chunk.sound is None:
                    self._unpacked(file, chunk)

    @property
    def damage(self) -> list[Damage]:
        """Parts that cannot be read, as far as the file was read or checked."""
        found = list(self._damage)
        for number, chunk in enumerate(self._chunks):
            if chunk.sound is False:
                what = "region" if chunk.lost else "chunk"
                span = self._span_of(number)
                found.append(Damage(what, chunk.at, chunk.size, *span))
        return sorted(found, key=lambda one: one.at)

    def gaps(self, keys: Iterable[int]) -> list[int]:
        """Return where messages of some channels may be missing.

        Returns:
            Places among all messages of the file, ascending.
        """
        wanted = list(keys)
        return [
            chunk.base
            for chunk in self._chunks
            if chunk.sound is False and chunk.may_have(wanted)
        ]

    def _span_of(self, number: int) -> tuple[int | None, int | None]:
        """Return the time of a chunk, or that between its neighbours.

        Its first message may have cycles that ended before its own time.
        """
        chunk = self._chunks[number]
        if chunk.first_ns is not None and self.span_ns is not None:
            return max(chunk.first_ns - SPAN_NS, self.span_ns[0]), chunk.last_ns
        before = [one.last_ns for one in self._chunks[:number]]
        after = [one.first_ns for one in self._chunks[number:]]
        return (
            max((one for one in before if one is not None), default=None),
            min((one for one in after if one is not None), default=None),
        )

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The least and the greatest time of a message; None if there are none."""
        firsts = [one.first_ns for one in self._chunks if one.first_ns is not None]
        lasts = [one.last_ns for one in self._chunks if one.last_ns is not None]
        return (min(firsts), max(lasts)) if firsts else None

    def load(self, keys: Iterable[int] | None = None) -> None:
        """Read the messages of some channels, or all, in one pass through the file."""
        every = self.channels if keys is None else keys
        wanted = [key for key in every if key not in self._rows]
        if not wanted:
            return
        found: dict[int, list[Rows]] = {key: [] for key in wanted}
        with scan.open_log(self.path) as file:
            for chunk in self._chunks:
                if not chunk.may_have(wanted):
                    continue
                data, records = self._unpacked(file, chunk)
                messages = records[records[:, _TYPE] == scan.MESSAGE]
                for key, each in found.items():
                    own = messages[messages[:, _CHANNEL] == key]
                    each.append(Rows.of(data, own[:, _AT], own[:, _SIZE], chunk.base))
        self._rows |= {key: Rows.joined(each) for key, each in found.items()}

    def rows(self, key: int) -> Rows:
        """Return the messages of a channel, in the order of the file."""
        self.load([key])
        return self._rows[key]

    @staticmethod
    def _unpacked(file: BinaryIO, chunk: _Chunk) -> tuple[bytes, NDArray[np.int64]]:
        """Return a chunk's content and its records; nothing if it is damaged."""
        data = None if chunk.lost else scan.unpacked(_read(file, chunk.at, chunk.size))
        records = None if data is None else scan.records(data)
        chunk.sound = records is not None
        if data is None or records is None:
            return b"", np.zeros((0, 4), np.int64)
        return data, records


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


def _texts(data: bytes, at: int, count: int) -> tuple[list[str], int]:
    """Return texts with their lengths before them, and the offset after them."""
    texts: list[str] = []
    for _ in range(count):
        size = int.from_bytes(data[at : at + 4], "little")
        texts.append(data[at + 4 : at + 4 + size].decode(errors="replace"))
        at += 4 + size
    return texts, at


def _map(data: bytes, at: int) -> dict[str, str]:
    end = min(at + 4 + int.from_bytes(data[at : at + 4], "little"), len(data))
    at += 4
    found: dict[str, str] = {}
    while at < end:
        (key, value), at = _texts(data, at, 2)
        found[key] = value
    return found


def _attachment(content: bytes) -> Attached:
    (name, kind), at = _texts(content, 16, 2)
    size = int.from_bytes(content[at : at + 8], "little")
    return Attached(name, content[at + 8 : at + 8 + size], kind)
