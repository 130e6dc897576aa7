"""Writing a log: one MCAP file, valid up to its last chunk wherever it is truncated.

If a file cannot grow any further, its writer gets an `OSError`, and the file ends after
the last record that was written whole.
"""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec

from pbonet.errors import LogError

from .events import LOG_SCHEMA, log_message
from .records import (
    EPOCH,
    MACHINE,
    METADATA,
    RUN,
    Attached,
    Origin,
    RunAbout,
    TaskAbout,
    checked,
    free_name,
)
from .schema import COMMITS, StepSchema, TaskSchema
from .time_conversion import Moves

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from mcap.data_stream import RecordBuilder
    from mcap.records import ChunkIndex

CHUNK: Final = 256 << 10
"""Bytes of messages in a chunk, before compression."""


class _Whole:
    """An unbuffered file that grows by whole writes or not at all.

    Args:
        path: The file, which must not exist.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self._at = 0
        self.failed = False

    def write(self, data: bytes) -> int:
        if self.failed:
            return len(data)  # lets the library empty its buffer; the file is closed
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            self.failed = True
            os.ftruncate(self._file.fileno(), self._at)
            raise
        self._at += len(data)
        return len(data)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        """Do nothing, because nothing is buffered."""

    def is_at(self, path: Path) -> bool:
        """Return whether this is its file, or that cannot be known."""
        try:
            return os.path.samestat(path.stat(), os.fstat(self._file.fileno()))
        except FileNotFoundError:
            return False
        except OSError:
            return True

    def close(self) -> None:
        self._file.close()


class _ChunkIndexes:
    """The index of the file's chunks, in the form in which it is written at the end.

    It stands for the library's list of records, which takes five times the memory.
    """

    def __init__(self) -> None:
        self._packed = bytearray()
        self.count = 0

    def append(self, index: ChunkIndex) -> None:
        """Add the record of a chunk."""
        from mcap.data_stream import RecordBuilder

        builder: Any = RecordBuilder()
        index.write(builder)
        self._packed += builder.end()
        self.count += 1

    def __iter__(self) -> Iterator[_ChunkIndexes]:
        """Yield what writes all records."""
        yield self

    def write(self, builder: RecordBuilder) -> None:
        """Write all records."""
        builder.write(self._packed)


class _Task:
    """The two channels of a task."""

    def __init__(
        self, schema: TaskSchema, cycles: int, steps: int, moves: Moves
    ) -> None:
        self.schema = schema
        self.epoch_ns = None if moves.drifts else moves.add[0]
        self.moves = moves
        self.cycles = cycles
        self.steps = steps


class LogWriter:
    """Writes one log.

    Args:
        path: The file, which must not exist.
        about: The run.
        attached: Files to attach.

    Raises:
        LogError: It exists or cannot be made.
        OSError: No room is left.
    """

    def __init__(
        self, path: Path, about: RunAbout, attached: Iterable[Attached] = ()
    ) -> None:
        from mcap.writer import CompressionType, Writer

        self.path = path
        self.about = about
        try:
            self._stream = _Whole(path)
        except OSError as error:
            raise LogError(
                "the log cannot be written",
                where=str(path),
                got=error.strerror or str(error),
                remedy="choose a folder that may be written to (PBONET_RUNS)",
            ) from None
        self._writer = Writer(
            cast("Any", self._stream),
            chunk_size=CHUNK,
            compression=CompressionType.ZSTD,
        )
        self._chunks = _ChunkIndexes()
        setattr(self._writer, "_Writer__chunk_indices", self._chunks)  # noqa: B010
        self._tasks: dict[int, _Task] = {}
        self._json: dict[str, int] = {}
        self._step_schema = 0
        self._counts: dict[int, int] = {}
        self._names: dict[str, bytes] = {}
        """Digests of attachments by name."""
        self._writer.start(profile="", library=f"pbonet {about.pbonet}")
        self._describe()
        for file in attached:
            self.attach(file)

    def _describe(self) -> None:
        """Describe the run, twice: one of them may be damaged."""
        about = msgspec.to_builtins(self.about)
        fields = checked(METADATA, {name: str(value) for name, value in about.items()})
        for _ in range(2):
            self._writer.add_metadata(METADATA, fields)

    def lasted(self, seconds: float) -> None:
        """Correct the elapsed virtual time, if it differs from the planned one.

        Raises:
            OSError: No room is left.
        """
        if seconds != self.about.seconds:
            self.about = msgspec.structs.replace(self.about, seconds=seconds)
            self._describe()

    @property
    def size(self) -> int:
        """The size of the file so far."""
        return self._stream.tell()

    @property
    def is_there(self) -> bool:
        """Whether its path still is this file; also if that cannot be known."""
        return self._stream.is_at(self.path)

    @property
    def chunks(self) -> int:
        """The number of chunks so far, each of which takes some memory to the end."""
        return self._chunks.count

    def attach(self, file: Attached) -> None:
        """Attach a file; a different file of the same name gets a number.

        Raises:
            OSError: No room is left.
        """
        digest = hashlib.sha256(file.data).digest()
        name = free_name(file.name, digest, self._names)
        if name in self._names:
            return
        self._names[name] = digest
        now = time.time_ns()
        self._writer.add_attachment(now, now, name, file.media_type, file.data)

    def add_task(self, about: TaskAbout, origin: Origin | None = None) -> int:
        """Return a number for `add`, by which a task's records are written.

        Args:
            about: The task.
            origin: Its origin; None for the log's own machine, run and clock.
        """
        schema = TaskSchema(about)
        metadata = schema.metadata()
        if origin is not None:
            metadata |= {MACHINE: origin.machine, RUN: origin.run}
            metadata[EPOCH] = str(origin.moves)
        if not self._step_schema:
            self._step_schema = self._writer.register_schema(
                StepSchema.NAME, "ros2msg", StepSchema.text().encode()
            )
        cycles = self._writer.register_channel(
            about.topic,
            "cdr",
            self._writer.register_schema(
                schema.name, "ros2msg", schema.text().encode()
            ),
            metadata,
        )
        steps = self._writer.register_channel(
            f"{about.topic}/steps", "cdr", self._step_schema, {"of": str(cycles)}
        )
        number = len(self._tasks) + 1
        moves = Moves.always(self.about.epoch_ns) if origin is None else origin.moves
        self._tasks[number] = _Task(schema, cycles, steps, moves)
        return number

    def add(self, task: int, records: bytes) -> int:
        """Write records read from a ring; return how many there were.

        Raises:
            OSError: No room is left.
            NodeError: The records are damaged.
        """
        one, total = self._tasks[task], 0
        for kind, count, release, end, data in one.schema.encode(records):
            epoch = one.moves.one(end) if one.epoch_ns is None else one.epoch_ns
            channel = one.cycles if kind in COMMITS else one.steps
            self._put(channel, end + epoch, data, release + epoch)
            total += count
        return total

    def add_event(self, event: dict[str, Any]) -> None:
        """Write an event, as a message that viewers list among logs.

        Raises:
            OSError: No room is left.
        """
        time_ns = int(event["time"]) + self.about.epoch_ns
        data = log_message(event, time_ns, self.about.subsystem)
        channel = self._channel("events", "foxglove.Log", LOG_SCHEMA)
        self._put(channel, time_ns, msgspec.json.encode(data), time_ns)

    def add_command(self, command: dict[str, Any]) -> None:
        """Write a command and its answer, at the time of the answer.

        Raises:
            OSError: No room is left.
        """
        schema = {"type": "object", "title": "pbonet.Command"}
        channel = self._channel("commands", "pbonet.Command", schema)
        time_ns = int(command["ended_ns"]) + self.about.epoch_ns
        data = msgspec.json.encode({"rtpu": self.about.rtpu, **command})
        self._put(channel, time_ns, data, time_ns)

    def add_status(self, now_ns: int, status: dict[str, Any]) -> None:
        """Write counts about the run, at the given time.

        Raises:
            OSError: No room is left.
        """
        schema = {"type": "object", "title": "pbonet.Status"}
        channel = self._channel(f"status/{self.about.rtpu}", "pbonet.Status", schema)
        time_ns = now_ns + self.about.epoch_ns
        self._put(channel, time_ns, msgspec.json.encode(status), time_ns)

    def add_clocks(self, now_ns: int, clocks: dict[str, Any]) -> None:
        """Write the offsets of other machines' clocks from this one's.

        Args:
            now_ns: The time, CLOCK_MONOTONIC.
            clocks: ``machine``, and ``others`` with ``rtpu``, ``machine``, and the
                nanoseconds by which each is ahead: ``offset_ns``, ``within_ns``.

        Raises:
            OSError: No room is left.
        """
        schema = {"type": "object", "title": "pbonet.Clocks"}
        channel = self._channel(f"clocks/{self.about.rtpu}", "pbonet.Clocks", schema)
        time_ns = now_ns + self.about.epoch_ns
        self._put(channel, time_ns, msgspec.json.encode(clocks), time_ns)

    def _channel(self, what: str, name: str, schema: dict[str, Any]) -> int:
        if what not in self._json:
            text = msgspec.json.encode(schema)
            number = self._writer.register_schema(name, "jsonschema", text)
            topic = f"{self.about.subsystem}/{what}"
            self._json[what] = self._writer.register_channel(topic, "json", number)
        return self._json[what]

    def _put(self, channel: int, log_ns: int, data: bytes, publish_ns: int) -> None:
        sequence = self._counts.get(channel, 0)
        self._counts[channel] = sequence + 1
        self._writer.add_message(channel, log_ns, data, publish_ns, sequence)

    def flush(self) -> None:
        """Write the chunk that is being filled.

        Raises:
            OSError: No room is left.
        """
        # The library closes chunks by size only; a slow run would lose minutes.
        getattr(self._writer, "_Writer__finalize_chunk")()  # noqa: B009

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: No room is left; what was written remains readable.
        """
        try:
            if not self._stream.failed:
                cast("Any", self._writer).finish()
        finally:
            self._stream.close()
