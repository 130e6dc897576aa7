"""Logs made from logs: merging several, or recovering a truncated one."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import msgspec

from pbonet.errors import LogError

from .clocks import Clock, common
from .damage import Lost, lost_in
from .part import Part
from .reader import goes_on, parts_of
from .records import (
    ATTACHED,
    CLOCKS,
    EPOCH,
    MACHINE,
    METADATA,
    RUN,
    checked,
    free_name,
    is_ours,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from mcap.writer import Writer

    from .part import Channel, Schema


class Merged(NamedTuple):
    """The result of merging several logs."""

    messages: int
    clocks: list[Clock]
    """Conversion of each file's times to those of the first."""
    damage: list[Lost]
    """Parts that could not be read, and are missing."""


def merge(paths: Sequence[Path], out: Path) -> Merged:
    """Write one log with the content of several, ordered by time.

    Truncated or damaged parts are left out. Equal channels of several files become one.
    Times of other machines are converted to the first file's, as far as their agents
    measured the clocks' offsets.

    Args:
        paths: Logs, or folders of runs.
        out: The new file.

    Returns:
        The number of messages, the conversions of times, and what is damaged.

    Raises:
        LogError: One of them is not a log, or the new file exists or cannot be written.
    """
    parts = parts_of(paths)
    clocks = common(parts)
    try:
        with out.open("xb") as file:
            return Merged(_write(parts, clocks, file), clocks, lost_in(parts, clocks))
    except OSError as error:
        raise LogError(
            "the log cannot be written",
            where=str(out),
            got=error.strerror or str(error),
            remedy="choose another file",
        ) from None


def recover(path: Path, out: Path) -> Merged:
    """Write a complete log with what a truncated or damaged log still contains.

    Returns:
        The number of messages, and what is damaged.

    Raises:
        LogError: It is not a log, or the new file exists or cannot be written.
    """
    return merge([path], out)


def _write(
    parts: Sequence[Part],
    clocks: Sequence[Clock],
    file: Any,  # noqa: ANN401 - a file
) -> int:
    from mcap.writer import CompressionType, Writer as McapWriter

    writer = McapWriter(file, chunk_size=256 << 10, compression=CompressionType.ZSTD)
    writer.start(profile="", library="pbonet")
    for name, values in _metadata(parts, clocks, _attach(parts, writer)):
        for _ in range(2 if is_ours(name) else 1):  # one of them may be damaged
            writer.add_metadata(name, checked(name, values))
    numbers = _channels(parts, clocks, writer)
    count = 0
    messages = [
        _messages(place, part, clocks[place]) for place, part in enumerate(parts)
    ]
    for time_ns, place, _, key, data in heapq.merge(*messages):
        writer.add_message(numbers[place, key], time_ns, data, time_ns, count)
        count += 1
    cast("Any", writer).finish()
    return count


def _metadata(
    parts: Sequence[Part],
    clocks: Sequence[Clock],
    renamed: Sequence[dict[str, str]],
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the metadata records of all files; equal names get numbers.

    Args:
        parts: The files.
        clocks: The conversions of their times.
        renamed: New names of each file's attachments.
    """
    number = 0
    for part, names in zip(parts, renamed, strict=True):
        for source in part.sources if part.about else ():
            number += 1
            own = source.attached or {name: name for name in names}
            told = {name: names[now] for name, now in own.items() if now in names}
            fields = {k: str(v) for k, v in msgspec.to_builtins(source.about).items()}
            fields[ATTACHED] = msgspec.json.encode(told).decode()
            yield METADATA if number == 1 else f"{METADATA} {number}", fields
    taken: dict[str, dict[str, str]] = {}
    for part in parts:
        for name, values in part.metadata.items():
            if not is_ours(name):
                free = free_name(name, values, taken)
                if free not in taken:
                    yield free, values
                taken[free] = values
    if len(parts) > 1:
        each = [f"{n} {part.path.name}" for n, part in enumerate(parts, 1)]
        told = dict(zip(each, map(str, clocks), strict=True))
        yield free_name(CLOCKS, told, taken), told


def _attach(parts: Sequence[Part], writer: Writer) -> list[dict[str, str]]:
    """Attach the files' attachments; different ones of one name get numbers.

    Returns:
        For each file, the new names of its attachments by their old names.
    """
    taken: dict[str, bytes] = {}
    renamed: list[dict[str, str]] = []
    for part in parts:
        names: dict[str, str] = {}
        for one in part.attached.values():
            name = free_name(one.name, one.data, taken)
            if name not in taken:
                writer.add_attachment(0, 0, name, one.media_type, one.data)
            taken[name] = one.data
            names[one.name] = name
        renamed.append(names)
    return renamed


def _channels(
    parts: Sequence[Part],
    clocks: Sequence[Clock],
    writer: Any,  # noqa: ANN401 - the library's
) -> dict[tuple[int, int], int]:
    """Add the channels; return their numbers by file and number in the file."""
    schemas: dict[Schema, int] = {}
    channels: dict[tuple[Any, ...], int] = {}
    numbers: dict[tuple[int, int], int] = {}
    origin = 0
    for place, part in enumerate(parts):
        if not place or not goes_on(part, parts[place - 1]):
            origin = place
        for key, channel in part.channels.items():
            if channel.schema not in schemas:
                schemas[channel.schema] = writer.register_schema(*channel.schema)
            metadata = dict(channel.metadata)
            if channel.encoding == "cdr":
                metadata[EPOCH] = str(clocks[place].moved(metadata.get(EPOCH)))
                metadata.setdefault(MACHINE, part.about.machine if part.about else "")
                metadata.setdefault(RUN, part.about.run if part.about else "")
            if "of" in metadata:
                metadata["of"] = str(numbers[place, int(metadata["of"])])
            known = _identity(channel, metadata, origin)
            if known not in channels:
                channels[known] = writer.register_channel(
                    channel.topic, channel.encoding, schemas[channel.schema], metadata
                )
            numbers[place, key] = channels[known]
    return numbers


def _identity(
    channel: Channel, metadata: dict[str, str], origin: int
) -> tuple[Any, ...]:
    """Return what two channels must have in common to become one.

    Channels of a task are merged only if each file continues the one before it.
    """
    if channel.encoding == "cdr":
        return (origin, channel.topic, *sorted(metadata.items()))
    return (channel.topic, channel.encoding, channel.schema)


def _messages(
    number: int, part: Part, clock: Clock
) -> Iterator[tuple[int, int, int, int, bytes]]:
    """Yield time, file, place, channel and data of each message, by place in the file.

    Records of one task must stay in order, but clocks may be set back; so times are
    kept from decreasing.
    """
    part.load()
    rows = [
        (at, time_ns, key, data)
        for key in part.channels
        for one in [part.rows(key)]
        for at, time_ns, data in zip(
            one.places.tolist(),
            (one.times + clock.shifts(one.times)).tolist(),
            one.all(),
            strict=True,
        )
    ]
    rows.sort(key=lambda row: row[0])
    latest: dict[int, int] = {}
    out: list[tuple[int, int, int, int, bytes]] = []
    for at, time_ns, key, data in rows:
        time = max(time_ns, latest.get(key, 0))
        latest[key] = time
        out.append((time, number, at, key, data))
    out.sort(key=lambda row: row[:3])
    yield from out
