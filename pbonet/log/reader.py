"""Reading a run: one log, or all logs in a run's folder, complete or truncated."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np

from pbonet.errors import LogError, UnknownTaskError, did_you_mean

from .clocks import common
from .cycle_columns import ReadSchema, head
from .cycles import COLUMNS, Cycles, Written
from .damage import Lost, lost_in
from .part import Part
from .records import (
    EPOCH,
    MACHINE,
    RUN,
    Attached,
    Origin,
    Step,
    Table,
    TaskAbout,
    free_name,
)
from .rows import Rows
from .schema import HEAD

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from .clocks import Clock
    from .time_conversion import Moves


_ABOUT: Final = msgspec.json.Decoder(TaskAbout)


class Message(NamedTuple):
    """One message, with its time in nanoseconds since 1970."""

    topic: str
    time_ns: int
    data: bytes


class TaskLife:
    """One life of a task, from spawn to kill; its messages are read on demand.

    Args:
        about: Description of the task.
        part: The file in which it begins.
        keys: Its channels of cycles and of steps there.
        moves: Offset from CLOCK_MONOTONIC of its machine to nanoseconds since 1970 by
            the first file's clock.
    """

    def __init__(
        self, about: TaskAbout, part: Part, keys: tuple[int, ...], moves: Moves
    ) -> None:
        self.about = about
        self.part = part
        self.moves = moves
        self.schema = ReadSchema(about)
        self._pieces = [(part, keys)]
        self._counts: list[int] = []
        """How many of `commits` each file has."""
        told = part.channels[keys[0]].metadata
        here = (part.about.machine, part.about.run) if part.about else ("", "")
        self.origin = Origin(told.get(MACHINE, here[0]), told.get(RUN, here[1]), moves)
        self.table = Table(*self.origin[:2], about.domain, about.subsystem)
        """The table in which its commits are numbered."""
        self.only_last = part.about is not None and part.about.last > 0
        """Whether only the last seconds before an error were to be recorded."""
        self.name = about.task
        """Name of the task in this log; `SUBSYSTEM/TASK` if two subsystems have one."""

    def go_on(self, part: Part, keys: tuple[int, ...]) -> None:
        """Add its messages from the next file."""
        self._pieces.append((part, keys))

    @cached_property
    def commits(self) -> Rows:
        """Messages of cycles, claims and other commits."""
        each = [self.schema.cycles(part.rows(keys[0])) for part, keys in self._pieces]
        self._counts = [len(one) for one in each]
        return Rows.joined(each)

    @cached_property
    def groups(self) -> list[bytes]:
        """The group of out-vars of each of `commits`, in the format of a table."""
        return self.schema.groups(self.commits)

    @property
    def steps(self) -> list[bytes]:
        """Messages of all other steps."""
        return [
            one
            for part, keys in self._pieces
            for key in keys[1:]
            for one in part.rows(key).all()
        ]

    @cached_property
    def records(self) -> list[bytes]:
        """All its messages, in the order in which they were recorded."""
        return self._records[0]

    @property
    def gaps(self) -> list[int]:
        """Places in `records` before which messages may be missing: damaged chunks."""
        return self._records[1]

    @cached_property
    def _records(self) -> tuple[list[bytes], list[int]]:
        found: list[bytes] = []
        gaps: list[int] = []
        for part, keys in self._pieces:
            part.load(keys)
        commits, begin = self.commits, 0
        texts = commits.all()
        for (part, keys), count in zip(self._pieces, self._counts, strict=True):
            own = slice(begin, begin := begin + count)
            steps = [part.rows(key) for key in keys[1:]]
            places = np.concatenate([
                commits.places[own],
                *(one.places for one in steps),
            ])
            messages = [*texts[own], *(text for one in steps for text in one.all())]
            order = np.argsort(places, kind="stable")
            lost = np.searchsorted(places[order], part.gaps(keys))
            gaps += (lost + len(found)).tolist()
            found += [messages[i] for i in order]
        return found, gaps


class Log(Cycles):
    """A recorded run.

    Args:
        path: A log, or the folder of a run with all its logs.

    Raises:
        LogError: There is none, one is damaged from the beginning or of a newer
            version, or they belong to several runs.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.where = str(path)
        self.parts = parts_of([self.path])
        runs = {part.about.run for part in self.parts if part.about}
        if len(runs) > 1:
            raise LogError(
                "the folder holds logs of several runs",
                where=str(self.path),
                expected="one run",
                got=", ".join(sorted(runs)),
                remedy="name one of the files, or merge them by `pbonet log merge`",
            )
        self.clocks = common(self.parts)
        """Conversion of each file's times to those of the first."""
        self._lives = _lives(self.parts, self.clocks)
        self._names = _name(self._lives)
        self._arrays: dict[str, dict[str, NDArray[Any]]] = {}
        first = next((part.about for part in self.parts if part.about), None)
        self.about = msgspec.to_builtins(first) if first is not None else {}

    @property
    def tasks(self) -> list[str]:
        """The names of the tasks."""
        return list(dict.fromkeys(life.name for life in self._lives))

    def name_of(self, subsystem: str, task: str) -> str:
        """Return the name of a subsystem's task in this log."""
        return self._names.get((subsystem, task), task)

    def all_lives(self) -> list[TaskLife]:
        """Return each life of every task."""
        return list(self._lives)

    def lives(self, task: str) -> list[TaskLife]:
        """Return each life of a task, by file, in order.

        Raises:
            UnknownTaskError: The log has no such task.
        """
        found = [life for life in self._lives if life.name == task]
        if not found:
            raise UnknownTaskError(
                f"the log has no task {task}",
                where=str(self.path),
                expected=" or ".join(self.tasks) or "a log with tasks",
                remedy=self._writer(task) or did_you_mean(task, self.tasks),
            )
        return found

    def _writer(self, name: str) -> str:
        """Return a hint if a variable's name was given instead of a task's."""
        found = [one for one in self.tasks if name in self.variables(one)]
        return f"{name} is a variable of {' and '.join(found)}" if found else ""

    def task_about(self, task: str) -> TaskAbout:
        """Return the description of a task's last life.

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

    def unit(self, variable: str) -> str:
        """Return the unit of a variable; empty if no task wrote it."""
        written = (one for life in self._lives for one in life.about.outvar)
        return next((one.units for one in written if one.name == variable), "")

    def arrays(self, task: str) -> dict[str, NDArray[Any]]:
        """Return the columns and variables of a task's cycles, by name.

        If a task was spawned again with other out-vars, only lives with its last ones
        are included. Times (`COLUMNS`) are in nanoseconds of CLOCK_MONOTONIC of the
        first file's machine; a variable has one row per cycle, in its unit.

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
            each = [self._in_time(one) for one in alike]
            whole = {name: np.concatenate([a[name] for a in each]) for name in names}
            chosen = whole["kind"] == Step.CYCLE
            self._arrays[task] = {n: values[chosen] for n, values in whole.items()}
            for name in COLUMNS:
                if self._arrays[task][name].dtype.kind in "iu":
                    values = self._arrays[task][name].astype(np.int64)
                    self._arrays[task][name] = values
        return self._arrays[task]

    def written(self, variable: str) -> list[Written]:
        """Return what each life of a task wrote to a variable, by file.

        Of several subsystems with such a variable it is that of the first task.

        Raises:
            UnknownVariableError: No task of the run wrote it.
        """
        lives = [
            life
            for life in self._lives
            if variable in {one.name for one in life.about.outvar}
            and variable not in life.about.hidden
        ]
        found: list[Written] = []
        for life in lives:
            if life.about.subsystem == lives[0].about.subsystem:
                arrays = self._in_time(life)
                cycles = arrays["kind"] == Step.CYCLE
                releases = arrays["release_ns"][cycles].astype(np.int64)
                found.append(Written(life.name, releases, arrays[variable][cycles]))
        self.must_be_written(variable, found)
        return found

    def _in_time(self, life: TaskLife) -> dict[str, NDArray[Any]]:
        """Return the arrays of a life, with times by the first file's clock."""
        arrays = life.schema.arrays(life.commits)
        for name in ("release_ns", "start_ns", "end_ns"):
            arrays[name] += life.moves.of(arrays[name]) - self.epoch_ns
        return arrays

    @property
    def complete(self) -> bool:
        """Whether all its files were finished."""
        return all(part.complete for part in self.parts)

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return sum(part.size for part in self.parts)

    @property
    def damage(self) -> list[Lost]:
        """Parts that cannot be read, as far as it was read or checked (`check`)."""
        return lost_in(self.parts, self.clocks)

    def check(self) -> list[Lost]:
        """Read the rest of the log; return all damage."""
        for part in self.parts:
            part.check()
        return self.damage

    @property
    def epoch_ns(self) -> int:
        """Offset from the first machine's CLOCK_MONOTONIC to nanoseconds since 1970."""
        return self.clocks[0].epoch_ns

    @property
    def span_ns(self) -> tuple[int, int]:
        """The least and the greatest time of a message, in nanoseconds since 1970."""
        pairs = zip(self.parts, self.clocks, strict=True)
        spans = [
            tuple(time_ns + clock.shift(time_ns) for time_ns in part.span_ns)
            for part, clock in pairs
            if part.span_ns is not None
        ]
        if not spans:
            return 0, 0
        return min(span[0] for span in spans), max(span[1] for span in spans)

    @cached_property
    def attached(self) -> dict[str, Attached]:
        """The attached files, by name; different files of one name get numbers."""
        found: dict[str, Attached] = {}
        contents: dict[str, bytes] = {}
        for part in self.parts:
            for one in part.attached.values():
                name = free_name(one.name, one.data, contents)
                contents[name] = one.data
                found.setdefault(name, one)
        return found

    def load(self) -> None:
        """Read all messages in one pass, if most of them are needed."""
        for part in self.parts:
            part.load()

    def messages(self, encoding: str, ending: str = "") -> Iterator[Message]:
        """Yield the messages of an encoding by time, optionally by ending of the topic.

        Times are by the clock of the first file's machine.
        """
        found: list[tuple[int, int, int, str, bytes]] = []
        for number, part in enumerate(self.parts):
            for key, channel in part.channels.items():
                if channel.encoding == encoding and channel.topic.endswith(ending):
                    rows = part.rows(key)
                    times = rows.times + self.clocks[number].shifts(rows.times)
                    found += [
                        (time_ns, number, at, channel.topic, data)
                        for time_ns, at, data in zip(
                            times.tolist(),
                            rows.places.tolist(),
                            rows.all(),
                            strict=True,
                        )
                    ]
        found.sort(key=lambda row: row[:3])
        for time_ns, _, _, topic, data in found:
            yield Message(topic, time_ns, data)

    def events(self) -> list[dict[str, Any]]:
        """Return the events, by time."""
        found = [
            msgspec.json.decode(one.data) for one in self.messages("json", "/events")
        ]
        return [cast("dict[str, Any]", one["event"]) for one in found]

    def commands(self) -> list[dict[str, Any]]:
        """Return the commands to the subsystem, by the time of their answers.

        Each has ``rtpu``, ``op``, ``client``, ``asked``, ``ok``, ``error``,
        ``warnings``, ``result``, ``begun_ns``, ``ended_ns``, and ``wall``: the time of
        its answer in seconds since 1970.
        """
        return [
            {"rtpu": "", "wall": one.time_ns * 1e-9}
            | msgspec.json.decode(one.data, type=dict[str, Any])
            for one in self.messages("json", "/commands")
        ]

    @property
    def begin_time_ns(self) -> int:
        """Time of the first commit of any task, in nanoseconds since 1970."""
        times = [
            end + one.moves.one(end)
            for one in self._lives
            if one.commits
            for end in [int(head(one.commits[0])["end_ns"])]
        ]
        return min(times, default=0)

    def missed(self) -> dict[str, int]:
        """Return the number of releases that tasks have missed since they were spawned.

        The counts are recorded once a second, and when a task was turned on or off or
        has failed; tasks of a simulation are not included.
        """
        return self._counted("missed")

    def failed(self) -> dict[str, int]:
        """Return the number of cycles that ended in an error, counted as `missed`."""
        return self._counted("failed")

    def _counted(self, key: str) -> dict[str, int]:
        """Return the sum of a count over all processes of each task."""
        before: dict[str, tuple[int, int]] = {}
        found: dict[str, int] = {}
        for _, task, counts in self.counted():
            cycles, count = counts["cycles"], counts[key]
            last = before.get(task, (0, 0))
            again = cycles < last[0] or count < last[1]  # it was spawned again
            found[task] = found.get(task, 0) + count - (0 if again else last[1])
            before[task] = cycles, count
        return found

    def counted(self) -> Iterator[tuple[int, str, dict[str, int]]]:
        """Yield what RTPUs counted of tasks, about once a second, by time.

        Yields:
            The time in nanoseconds since 1970, the task, and its ``cycles``, ``missed``
            and ``failed`` since it was spawned.
        """
        for one, subsystem, status in self._statuses():
            for short, counts in status["tasks"].items():
                task = self.name_of(subsystem, short)
                found = {"cycles": counts["cycles"]}
                found |= {key: counts.get(key, 0) for key in ("missed", "failed")}
                yield one.time_ns, task, found

    def _statuses(self) -> Iterator[tuple[Message, str, dict[str, Any]]]:
        """Yield each status of a recorder, with its subsystem and content."""
        for one in self.messages("json"):
            subsystem, is_status, _ = one.topic.partition("/status/")
            if is_status:
                status = cast("dict[str, Any]", msgspec.json.decode(one.data))
                yield one, subsystem, status

    @property
    def only_last(self) -> bool:
        """Whether only the last seconds before each error were to be recorded."""
        return any(life.only_last for life in self._lives)

    def lost(self) -> dict[str, int]:
        """Return how many records of each task are missing that were to be recorded.

        They did not fit its ring, or the disk was full or too slow for them. Records
        say what did not fit the ring before them, the end of a file what its recorder
        has lost in all.
        """
        found: dict[str, int] = {}
        for life in self._lives:
            each = [one for one in (life.commits, life.steps) if one]
            count = max((int(head(one[-1])["lost"]) for one in each), default=0)
            if life.only_last and each:
                count -= min(int(head(one[0])["lost"]) for one in each)
            if count:
                found[life.name] = found.get(life.name, 0) + count
        for _, subsystem, status in self._statuses():
            for short, count in status.get("lost", {}).items():
                task = self.name_of(subsystem, short)
                found[task] = max(count, found.get(task, 0))
        return found


def parts_of(paths: Sequence[Path]) -> list[Part]:
    """Return the files of some paths, in the order of their runs.

    Raises:
        LogError: There is none, one is not a log or of a newer version, or none of
            them has any record.
    """
    each = [Part(path) for one in paths for path in files_of(one)]
    if not any(part.chunks or part.channels or part.metadata for part in each):
        raise LogError(
            "the log is empty: it was truncated before its first complete record",
            where=" ".join(map(str, paths)),
            expected="a log that was written for half a second or more, or finished",
            got=", ".join(f"{part.size} bytes" for part in each),
            remedy="name another one; nothing in this one can be recovered",
        )
    return sorted(each, key=_place_of)


def files_of(path: Path) -> list[Path]:
    """Return the logs of a path: the file itself, or those in the folder.

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
        folder: The folder of runs; by default PBONET_RUNS, else ``runs``.

    Raises:
        LogError: There is no run.
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


def _place_of(part: Part) -> tuple[bool, str, str, str, int, str]:
    """Return the sort key of a file: by run; other programs' files come last."""
    one = part.about
    if one is None:
        return True, "", "", "", 0, part.path.name
    return False, one.run, one.subsystem, one.rtpu, one.part, part.path.name


def _name(lives: list[TaskLife]) -> dict[tuple[str, str], str]:
    """Add subsystems to names of tasks that are not unique; return all names."""
    homes: dict[str, set[str]] = {}
    for life in lives:
        homes.setdefault(life.about.task, set()).add(life.about.subsystem)
    for life in lives:
        if len(homes[life.about.task]) > 1:
            life.name = life.about.topic
    return {(one.about.subsystem, one.about.task): one.name for one in lives}


def _lives(parts: list[Part], clocks: list[Clock]) -> list[TaskLife]:
    """Return the lives of the tasks of all files."""
    found: list[TaskLife] = []
    before: list[tuple[Part, TaskLife]] = []
    for part, clock in zip(parts, clocks, strict=True):
        here: list[tuple[Part, TaskLife]] = []
        for about, keys in _tasks(part):
            life = next(
                (
                    one
                    for last, one in before
                    if goes_on(part, last) and one.about == about
                ),
                None,
            )
            if life is None:
                told = part.channels[keys[0]].metadata.get(EPOCH)
                life = TaskLife(about, part, keys, clock.moved(told))
                found.append(life)
            else:
                life.go_on(part, keys)
            here.append((part, life))
        before = here
    return found


def goes_on(part: Part, last: Part) -> bool:
    """Return whether a file continues the one before it without a gap."""
    if part.about is None or last.about is None or not part.about.goes_on:
        return False
    one, before = part.about, last.about
    return last.complete and (one.run, one.subsystem, one.rtpu, one.part) == (
        *(before.run, before.subsystem, before.rtpu),
        before.part + 1,
    )


def _tasks(part: Part) -> Iterator[tuple[TaskAbout, tuple[int, ...]]]:
    """Yield the lives of the tasks of one file, with their channels."""
    steps = {
        int(one.metadata.get("of", 0)): key
        for key, one in part.channels.items()
        if one.topic.endswith("/steps")
    }
    for key, channel in sorted(part.channels.items()):
        text = channel.metadata.get("about")
        if channel.encoding != "cdr" or text is None:
            continue
        try:
            about = _ABOUT.decode(text)
        except msgspec.MsgspecError:
            continue
        yield about, ((key, steps[key]) if key in steps else (key,))
