"""Logs made of logs: one out of several, or a whole one out of one that was cut."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Any, cast

from pbonet.errors import LogError

from .part import Part
from .reader import files_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from .part import Channel, Schema


def merge(paths: Sequence[Path], out: Path) -> int:
    """Write one log with what stands in several, ordered by time.

    What was cut short or damaged is left out. Where channels of several files are the
    same, the new file has one.

    Args:
        paths: Logs, or folders of runs.
        out: The new file.

    Returns:
        How many messages it has.

    Raises:
        LogError: One of them is no log, or the new file stands or cannot be written.
    """
    parts = [Part(path) for one in paths for path in files_of(one)]
    try:
        with out.open("xb") as file:
            return _write(parts, file)
    except OSError as error:
        raise LogError(
            "the log cannot be written",
            where=str(out),
            got=error.strerror or str(error),
            remedy="choose another file",
        ) from None


def recover(path: Path, out: Path) -> int:
    """Write a whole log with what a log that was cut short still has.

    Returns:
        How many messages it has.

    Raises:
        LogError: It is no log, or the new file stands or cannot be written.
    """
    return merge([path], out)


def _write(parts: Sequence[Part], file: Any) -> int:  # noqa: ANN401 - a file
    from mcap.writer import CompressionType, Writer

    writer = Writer(file, chunk_size=256 << 10, compression=CompressionType.ZSTD)
    writer.start(profile="", library="pbonet")
    for part in parts[:1]:
        for name, values in part.metadata.items():
            writer.add_metadata(name, values)
    attached = {name: one for part in parts for name, one in part.attached.items()}
    for one in attached.values():
        writer.add_attachment(0, 0, one.name, one.media_type, one.data)
    schemas: dict[Schema, int] = {}
    channels: dict[tuple[Any, ...], int] = {}
    numbers: dict[tuple[int, int], int] = {}
    for place, part in enumerate(parts):
        for key, channel in part.channels.items():
            if channel.schema not in schemas:
                schemas[channel.schema] = writer.register_schema(*channel.schema)
            known = _identity(channel, place)
            if known not in channels:
                metadata = dict(channel.metadata)
                if "of" in metadata:
                    metadata["of"] = str(numbers[place, int(metadata["of"])])
                channels[known] = writer.register_channel(
                    channel.topic, channel.encoding, schemas[channel.schema], metadata
                )
            numbers[place, key] = channels[known]
    count = 0
    for time_ns, place, _, key, data in heapq.merge(*map(_messages, enumerate(parts))):
        writer.add_message(numbers[place, key], time_ns, data, time_ns, count)
        count += 1
    cast("Any", writer).finish()
    return count


def _identity(channel: Channel, place: int) -> tuple[Any, ...]:
    """Return what two channels share that may become one; a task's never do."""
    if channel.encoding == "cdr":
        return (place, channel.topic, *sorted(channel.metadata.items()))
    return (channel.topic, channel.encoding, channel.schema)


def _messages(
    numbered: tuple[int, Part],
) -> Iterator[tuple[int, int, int, int, bytes]]:
    """Yield time, file, place and channel of each message, by place in the file.

    Records of one task must stay in their order, though their times may repeat; so a
    time never goes back.
    """
    number, part = numbered
    part.load()
    rows = [
        (at, time_ns, key, data)
        for key in part.channels
        for at, time_ns, data in zip(
            part.rows(key).places.tolist(),
            part.rows(key).times.tolist(),
            part.rows(key).all(),
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
