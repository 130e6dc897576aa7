"""Reading a run: one log, or all logs in a run's folder, cut short or not."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np

from pbonet.errors import LogError, UnknownTaskError, did_you_mean

from . import scan
from .cycles import COLUMNS, Cycles
from .records import FORMAT, METADATA, Attached, RunAbout, Step, TaskAbout
from .schema import HEAD, TaskSchema, head

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from .scan import Content

_ABOUT: Final = msgspec.json.Decoder(TaskAbout)


class Schema(NamedTuple):
    """What the messages of a channel look like."""

    name: str
    encoding: str
    data: bytes


_NONE: Final = Schema("", "", b"")


class Channel(NamedTuple):
    """One channel of a file."""

    topic: str
    encoding: str
    schema: Schema
    metadata: dict[str, str]


class Message(NamedTuple):
    """One message, with its time in nanoseconds since 1970."""

    topic: str
    time_ns: int
    data: bytes


class Part:
    """One file of a run.

    Args:
        path: The file.

    Raises:
        LogError: It is none, or of a newer version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.messages: dict[int, list[tuple[int, int, bytes]]] = {}
        """Time, place among all, and data, by channel in the order of the file."""
        self.count = 0
        self.attached: dict[str, Attached] = {}
        self.damaged = 0
        """Chunks that could not be unpacked."""
        self.chunks = 0
        self.metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Schema] = {}
        with scan.open_log(path) as file:
            self.size = file.seek(0, 2)
            self.content: Content = scan.scan(file, str(path))
            self.about = self._read_about(file)
            self._read(file)

    @property
    def complete(self) -> bool:
        """Whether the file was finished."""
        return self.content.complete

    def _read_about(self, file: Any) -> RunAbout | None:  # noqa: ANN401 - a file
        for found in self.content.records:
            if found.opcode == scan.METADATA:
                name, values = _metadata(_content(file, found))
                self.metadata[name] = values
        known = self.metadata.get(METADATA)
        return None if known is None else _run_about(known, self.path)

    def _read(self, file: Any) -> None:  # noqa: ANN401 - a file
        for found in self.content.records:
            if found.opcode == scan.CHUNK:
                chunk = scan.unpacked(_content(file, found))
                self.chunks += 1
                if chunk is None:
                    self.damaged += 1
                else:
                    self._take(chunk)
            elif found.opcode in {scan.SCHEMA, scan.CHANNEL}:  # of no message, perhaps
                self._define(found.opcode, memoryview(_content(file, found)), 0)
            elif found.opcode == scan.ATTACHMENT:
                one = _attachment(_content(file, found))
                self.attached[one.name] = one

    def _take(self, chunk: memoryview) -> None:
        messages, first = self.messages, scan.MESSAGE_HEAD
        for opcode, at, size in scan.inside(chunk):
            if opcode == scan.MESSAGE:
                channel, log_ns, _ = scan.message(chunk, at)
                data = bytes(chunk[at + first : at + size])
                messages.setdefault(channel, []).append((log_ns, self.count, data))
                self.count += 1
            elif opcode in {scan.SCHEMA, scan.CHANNEL}:
                self._define(opcode, chunk, at)

    def _define(self, opcode: int, chunk: memoryview, at: int) -> None:
        """Take note of a schema or a channel."""
        number = int.from_bytes(chunk[at : at + 2], "little")
        if opcode == scan.SCHEMA:
            (name, encoding), at = _texts(chunk, at + 2, 2)
            size = int.from_bytes(chunk[at : at + 4], "little")
            data = bytes(chunk[at + 4 : at + 4 + size])
            self._schemas[number] = Schema(name, encoding, data)
            return
        schema = int.from_bytes(chunk[at + 2 : at + 4], "little")
        (topic, encoding), at = _texts(chunk, at + 4, 2)
        self.channels[number] = Channel(
            topic, encoding, self._schemas.get(schema, _NONE), _map(chunk, at)
        )


class Life(NamedTuple):
    """One spawn of a task in one file."""

    about: TaskAbout
    schema: TaskSchema
    commits: list[bytes]
    """Messages of cycles, claims and other commits."""
    steps: list[bytes]
    """Messages of what else it did."""
    records: list[bytes]
    """All of them, in the order in which they were made."""
    part: Part


class Log(Cycles):
    """A run that was recorded.

    Args:
        path: A log, or the folder of a run with all its logs.

    Raises:
        LogError: There is none, one is damaged from the beginning, or of a newer
            version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.parts = [Part(one) for one in files_of(self.path)]
        runs = {part.about.run for part in self.parts if part.about}
        if len(runs) > 1:
            raise LogError(
                "the folder holds logs of several runs",
                where=str(self.path),
                expected="one run",
                got=", ".join(sorted(runs)),
                remedy="name one of the files",
            )
        self._lives = list(itertools.chain.from_iterable(map(_lives, self.parts)))
        self._arrays: dict[str, dict[str, NDArray[Any]]] = {}
        first = next((part.about for part in self.parts if part.about), None)
        self.about = msgspec.to_builtins(first) if first is not None else {}

    @property
    def tasks(self) -> list[str]:
        """The names of the tasks."""
        return list(dict.fromkeys(life.about.task for life in self._lives))

    def lives(self, task: str) -> list[Life]:
        """Return each spawn of a task, by file, in order.

        Raises:
            UnknownTaskError: The log has no such task.
        """
        found = [life for life in self._lives if life.about.task == task]
        if not found:
            raise UnknownTaskError(
                f"the log has no task {task}",
                where=str(self.path),
                expected=" or ".join(self.tasks) or "a log with tasks",
                remedy=did_you_mean(task, self.tasks),
            )
        return found

    def task_about(self, task: str) -> TaskAbout:
        """Return what a task was when it was spawned last.

        Raises:
            UnknownTaskError: The log has no such task.
        """
        return self.lives(task)[-1].about

    def variables(self, task: str) -> list[str]:
        """Return the variables that a task wrote.

        Raises:
            UnknownTaskError: The log has no such task.
        """
        about = self.task_about(task)
        return [v.name for v in about.outvar if v.name not in about.hidden]

    def arrays(self, task: str) -> dict[str, NDArray[Any]]:
        """Return the columns and variables of a task's cycles, by name.

        Where a task was spawned again with other out-vars, its last ones count.

        Raises:
            UnknownTaskError: The log has no such task.
        """
        if task not in self._arrays:
            names = (*(name for name, _, _ in HEAD), *self.variables(task))
            last = self.task_about(task)
            alike = [
                one
                for one in self.lives(task)
                if (one.about.outvar, one.about.hidden) == (last.outvar, last.hidden)
            ]
            each = [one.schema.arrays(one.commits) for one in alike]
            whole = {name: np.concatenate([a[name] for a in each]) for name in names}
            chosen = whole["kind"] == Step.CYCLE
            self._arrays[task] = {n: values[chosen] for n, values in whole.items()}
            for name in COLUMNS:
                if self._arrays[task][name].dtype.kind in "iu":
                    values = self._arrays[task][name].astype(np.int64)
                    self._arrays[task][name] = values
        return self._arrays[task]

    @property
    def attached(self) -> dict[str, Attached]:
        """The files that the run carries, by name."""
        found: dict[str, Attached] = {}
        for part in self.parts:
            found = part.attached | found
        return found

    def messages(self, encoding: str = "") -> Iterator[Message]:
        """Yield all messages by time, those of one encoding if told."""
        rows = [
            (time_ns, number, at, channel.topic, data)
            for number, part in enumerate(self.parts)
            for key, channel in part.channels.items()
            if encoding in {"", channel.encoding}
            for time_ns, at, data in part.messages.get(key, [])
        ]
        rows.sort(key=lambda row: row[:3])
        for time_ns, _, _, topic, data in rows:
            yield Message(topic, time_ns, data)

    def events(self) -> list[dict[str, Any]]:
        """Return the events, by time."""
        found = [
            msgspec.json.decode(one.data)
            for one in self.messages("json")
            if one.topic.endswith("/events")
        ]
        return [cast("dict[str, Any]", one["event"]) for one in found]

    def lost(self) -> dict[str, int]:
        """Return how many records of each task did not fit its ring."""
        found: dict[str, int] = {}
        for life in self._lives:
            last = [one[-1] for one in (life.commits, life.steps) if one]
            count = max((int(head(one)["lost"]) for one in last), default=0)
            if count:
                task = life.about.task
                found[task] = found.get(task, 0) + count
        return found


def files_of(path: Path) -> list[Path]:
    """Return the logs that a path stands for: itself, or those in the folder.

    Raises:
        LogError: There is none.
    """
    if not path.is_dir():
        return [path]
    found = sorted(path.glob("*.mcap"))
    if not found:
        raise LogError(
            "the folder has no log",
            where=str(path),
            expected="run.mcap or other .mcap files",
            got="none",
            remedy="name the folder of one run, such as runs/<time>-<job>",
        )
    return found


def last_run(folder: str | Path = "") -> Path:
    """Return the folder of the newest run.

    Args:
        folder: Where runs are; PBONET_RUNS, else ``runs``, by default.

    Raises:
        LogError: There is none.
    """
    folder = folder or os.environ.get("PBONET_RUNS") or "runs"
    runs = sorted(path.parent for path in Path(folder).glob("*/*.mcap"))
    if not runs:
        raise LogError(
            "no run was recorded here",
            where=str(folder),
            expected="<time>-<job>/run.mcap",
            got="none",
            remedy="name a log, or run a job with `pbonet run`",
        )
    return runs[-1]


def _lives(part: Part) -> list[Life]:
    """Return the tasks of one file, spawn by spawn."""
    found: list[Life] = []
    steps = {
        int(one.metadata.get("of", 0)): part.messages.get(key, [])
        for key, one in part.channels.items()
        if one.topic.endswith("/steps")
    }
    for key, channel in part.channels.items():
        text = channel.metadata.get("about")
        if channel.encoding != "cdr" or text is None:
            continue
        try:
            about = _ABOUT.decode(text)
        except msgspec.MsgspecError:
            continue
        rows, others = part.messages.get(key, []), steps.get(key, [])
        ordered = sorted((*rows, *others), key=lambda row: row[1])
        found.append(
            Life(
                about=about,
                schema=TaskSchema(about),
                commits=[row[2] for row in rows],
                steps=[row[2] for row in others],
                records=[row[2] for row in ordered],
                part=part,
            )
        )
    return found


def _run_about(values: dict[str, str], path: Path) -> RunAbout:
    """Return which run a file is of.

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


def _content(file: Any, found: scan.Found) -> bytes:  # noqa: ANN401 - a file
    file.seek(found.at)
    return cast("bytes", file.read(found.size))


def _texts(data: memoryview, at: int, count: int) -> tuple[list[str], int]:
    """Return so many texts with their lengths before them, and what follows."""
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


def _metadata(content: bytes) -> tuple[str, dict[str, str]]:
    data = memoryview(content)
    (name,), at = _texts(data, 0, 1)
    return name, _map(data, at)


def _attachment(content: bytes) -> Attached:
    data = memoryview(content)
    (name, kind), at = _texts(data, 16, 2)
    size = int.from_bytes(data[at : at + 8], "little")
    return Attached(name, bytes(data[at + 8 : at + 8 + size]), kind)
