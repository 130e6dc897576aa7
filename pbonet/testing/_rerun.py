"""A whole configuration, run again in the time of its record.

Every task's code runs on the new outputs of the other tasks, in the recorded order and
with the recorded time steps: a task that read a certain commit reads the new one in its
place. External inputs are taken from the record: initial values, values set by an
operator, signals, parameters, and the commits of tasks that are not run again.
"""

from __future__ import annotations

import heapq
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from pbonet.errors import LogError, PbonetError
from pbonet.log import (
    CDR,
    HEAD_DTYPE,
    RECORD,
    Log,
    LogWriter,
    RunAbout,
    head,
    size,
    text,
)
from pbonet.master.tools import log_plot

from ._chance import sources_watched
from ._changed import note_changes
from ._inputs import Commits
from ._records import cycles_of, must_have_cycles, not_again
from ._run import Run, Stop
from ._trial import Trial
from ._verdict import Replayed, Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pbonet.config import Variable
    from pbonet.log import Table, TaskLife

    from ._inputs import Key
    from ._trial import Params

_HEAD_END = len(CDR) + HEAD_DTYPE.itemsize


class _Made(Commits):
    """The commits of a run: as they are made now, else as they were recorded.

    Args:
        log: The run.
        table: Which table.
    """

    fresh = True

    def __init__(self, log: Log, table: Table) -> None:
        super().__init__(log, table)
        self.made: dict[Key, bytes] = {}
        self.parts: dict[int, _Part] = {}
        """By the identity of their life."""
        self.consts: dict[str, _Part] = {}
        """The task that gave a constant last."""

    def find(self, key: Key) -> tuple[TaskLife, bytes, bool] | None:
        """Return a commit, once its task has reached it."""
        found = self._found.get(key)
        if found is None:
            return None
        life = found[0]
        part = self.parts.get(id(life))
        if part is not None:
            part.advance_to(key)
        group = self.made.get(key)
        if group is None:
            return super().find(key)
        return life, group, True


class _Part(Run):
    """One life of a task among the others.

    Args:
        life: Its records.
        made: The commits of all.
        libraries: Folders of modules, before those of the recording.
        verdict: The verdict to fill.
        rtol: How far a float may be off.
        tried: Parameters for which other values than the recorded ones are used.
    """

    def __init__(
        self,
        life: TaskLife,
        made: _Made,
        libraries: Sequence[str | Path],
        verdict: Verdict,
        rtol: float,
        *,
        tried: Trial | None,
    ) -> None:
        super().__init__(life, made, libraries, verdict, rtol, tried=tried)
        self._made = made
        self.name = life.name
        self._busy = False
        self.stopped = False
        self.diverged_ns = 0
        """When its first other value was made then; 0: none was."""
        rows = [head(one) for one in self._records]
        ends = np.array([row["end_ns"] for row in rows], np.int64)
        self._ends: list[int] = (ends + life.moves.of(ends)).tolist()
        self._places = {
            (int(row["register"]), int(row["number"])): place
            for place, row in enumerate(rows)
            if row["register"]
        }
        self._last: dict[str, tuple[bytes, bytes]] = {}
        """Variables and constants as it gave them last: recorded, and made."""
        made.parts[id(life)] = self

    @property
    def due_ns(self) -> int | None:
        """When its next record was made; None at the end."""
        if self.stopped or self._at >= len(self._records):
            return None
        return self._ends[self._at]

    def advance(self) -> None:
        """Run the step of the next record."""
        self._busy = True
        try:
            with self.outside():
                self.step()
        except Stop as stop:
            self.stopped = True
            if str(stop):
                self._verdict.gaps.append(str(stop))
        finally:
            self._busy = False

    def advance_to(self, key: Key) -> None:
        """Run until a commit is made, unless that is under way."""
        place = self._places.get(key, -1)
        while self._at <= place and not (self._busy or self.stopped):
            self.advance()

    def doubt(self, why: str) -> None:
        """Stop this task: from here on the others read its recorded outputs.

        Raises:
            Stop: Always.
        """
        self._verdict.missing = True
        raise Stop(why)

    def given(self, name: str) -> tuple[bytes, bytes] | None:
        """Return a variable as this task gave it last: recorded, and made."""
        return self._last.get(name)

    def compare(
        self, variables: Sequence[Variable], recorded: bytes, made: bytes
    ) -> bool:
        """Note the new outputs, and continue with them."""
        if self._key != (0, 0):
            self._made.made[self._key] = made
        at = 0
        for variable in variables:
            end = at + size([variable])
            self._last[variable.name] = recorded[at:end], made[at:end]
            self._made.consts[variable.name] = self
            at = end
        found = self.differ(variables, recorded, made)
        if found is None:
            return True
        if self._verdict.divergence is None:
            self._verdict.divergence = found
            self.diverged_ns = self._ends[min(self._at, len(self._ends)) - 1]
        return False

    def arrived(self, variables: Sequence[Variable], data: bytes) -> bytes:
        """Return recorded values with those in place that are made now."""
        parts: list[bytes] = []
        unseen: set[str] = set()
        at = 0
        for variable in variables:
            end = at + size([variable])
            value = data[at:end]
            by = self._made.consts.get(variable.name)
            last = by.given(variable.name) if by is not None else None
            if last is None and variable.name in self.about.hidden:
                unseen.add(variable.name)
            # What stood there then came from that task if it is what it had given.
            same = last is not None and last[0] == value
            parts.append(last[1] if last is not None and same else value)
            at = end
        self.unseen(unseen)
        return b"".join(parts)


@sources_watched()
def rerun(
    path: str | Path | Log,
    tasks: Sequence[str] = (),
    *,
    libraries: Sequence[str | Path] = (),
    rtol: float = 0.0,
    out: Path | None = None,
    params: Params | None = None,
    plot: Path | None = None,
) -> Replayed:
    """Run the code of several tasks again together, in recorded time.

    A simulation is simulated again, from the files that its log carries, unless
    parameters are tried.

    Args:
        path: The log, the folder of a run, or a `Log`.
        tasks: The tasks; none: those of `params`, or else all. For the others the
            record is used.
        libraries: Folders of modules, searched before those of the recording.
        rtol: Relative tolerance for floats; 0: identical to the bit.
        out: A log to write, with the new outputs of the tasks.
        params: Parameters to try in place of the recorded ones, by task and name. A
            value holds for the whole run, also where the recording has a `set` of it.
        plot: A picture to draw, of the outputs that differ.

    Raises:
        LogError: There is no log there, no cycle of a task that is named, or of any, or
            `out` cannot be written.
        UnknownTaskError: The log has no such task.
        PbonetError: The module of a task that is named does not load, or does not fit
            its RMOD; or a simulation cannot be simulated any more.
        ParameterError: There is no such parameter, or its value is refused.
    """
    log = path if isinstance(path, Log) else Log(path)
    trials = {task: Trial(values) for task, values in (params or {}).items()}
    named = list(dict.fromkeys([*tasks, *trials]))
    again = partial(_again, log, named, trials, libraries=libraries, rtol=rtol)
    if not (params or plot):
        return again(out)
    with TemporaryDirectory(prefix="pbonet-") as folder:
        file = out or Path(folder, "replay.mcap")
        found = again(file)
        now = Log(file)
        names = [one.task for one in found.tasks]
        found.differences = text.diff(log, now, names)
        if plot is not None:
            _draw(found, log, now, plot)
    return found


def _draw(found: Replayed, log: Log, now: Log, plot: Path) -> None:
    """Draw the outputs that differ.

    Raises:
        LogError: None does, or the plot cannot be written.
    """
    rows = found.differences
    names = [row["variable"] for row in rows if row["first"] is not None]
    if not names:
        raise LogError(
            "no output differs, so there is nothing to draw",
            where=str(log.path),
            remedy="leave the plot out, or use `pbonet log plot`",
        )
    log_plot.draw(log, names, plot, now)


def _again(
    log: Log,
    named: Sequence[str],
    trials: Mapping[str, Trial],
    out: Path | None,
    *,
    libraries: Sequence[str | Path],
    rtol: float,
) -> Replayed:
    if log.about.get("seconds") and not trials:
        from ._simulated import simulated

        return simulated(log, named, libraries=libraries, rtol=rtol, out=out)
    log.load()
    names = named or log.tasks
    verdicts = {task: Verdict(task=task, trial=bool(trials)) for task in names}
    for verdict in verdicts.values():
        note_changes(verdict, log, libraries)
        _note_trial(verdict, log, trials)
    made: dict[Table, _Made] = {}
    parts: list[_Part] = []
    begun = time.perf_counter()
    for task in names:
        for life in log.lives(task):
            verdicts[task].recorded += cycles_of(life)
            if life.table not in made:
                made[life.table] = _Made(log, life.table)
            if why := not_again(life):
                verdicts[task].gaps.append(why)
                continue
            one = made[life.table]
            try:
                trial, verdict = trials.get(task), verdicts[task]
                parts.append(_Part(life, one, libraries, verdict, rtol, tried=trial))
            except PbonetError as error:  # for the others the record is used
                if named:
                    raise
                verdicts[task].gaps.append(str(error))
    must_have_cycles(log, list(verdicts.values()), named)
    _go(parts)
    found = Replayed(tasks=list(verdicts.values()), took=time.perf_counter() - begun)
    _sum_up(found, parts)
    if out is not None:
        tried = {one.task: one.tried for one in found.tasks}
        _write(log, {name: one.made for name, one in made.items()}, tried, out)
    return found


def _note_trial(verdict: Verdict, log: Log, trials: Mapping[str, Trial]) -> None:
    """Note in a verdict which parameters are tried."""
    if (trial := trials.get(verdict.task)) is None:
        return
    about = log.task_about(verdict.task)
    verdict.tried = trial.sentences(about.rmod, about.rmod_name)
    verdict.params = [one for one in verdict.params if not trial.has(one.name)]


def _go(parts: list[_Part]) -> None:
    """Run all records in the order in which they were made."""
    waiting = [(due, n) for n, part in enumerate(parts) if (due := part.due_ns)]
    heapq.heapify(waiting)
    while waiting:
        due, number = heapq.heappop(waiting)
        part = parts[number]
        if part.due_ns == due:  # else it was needed before
            part.advance()
        if (following := part.due_ns) is not None:
            heapq.heappush(waiting, (following, number))
    for part in parts:
        if not part.stopped:
            part.end()


def _sum_up(found: Replayed, parts: list[_Part]) -> None:
    first = [(one.diverged_ns, one.name) for one in parts if one.diverged_ns]
    stopped = [one.divergence for one in found.tasks if one.divergence]
    found.first = min(first)[1] if first else ""
    if not first and stopped:
        found.first = next(one.task for one in found.tasks if one.divergence)
    found.seconds = max((one.seconds for one in found.tasks), default=0.0)


def _write(
    log: Log,
    each: Mapping[Table, dict[Key, bytes]],
    tried: Mapping[str, list[str]],
    out: Path,
) -> None:
    """Write a log of the new outputs, by table, with the other records.

    Args:
        log: What was recorded.
        each: The new outputs.
        tried: By task, parameters with other values than the recorded ones.
        out: The new log.
    """
    about = log.parts[0].about or RunAbout(
        run="", job="", subsystem="", domain="", rtpu=""
    )
    writer = LogWriter(out, msgspec.structs.replace(about, run=f"{about.run}-replay"))
    for file in log.attached.values():
        writer.attach(file)
    for life in log.all_lives():
        made = each.get(life.table, {})
        hidden = life.about.hidden if _partly(life, made) else []
        told = msgspec.structs.replace(
            life.about, hidden=hidden, tried=tried.get(life.name, [])
        )
        number = writer.add_task(told, life.origin)
        writer.add(number, b"".join(_records(life, made)))
    writer.close()


def _partly(life: TaskLife, made: dict[Key, bytes]) -> bool:
    """Return whether some commits of a task are the recorded ones."""
    heads = map(head, life.commits)
    return any((int(row["register"]), int(row["number"])) not in made for row in heads)


def _records(life: TaskLife, made: dict[Key, bytes]) -> list[bytes]:
    parts: list[bytes] = []
    for message in life.commits:
        row = np.frombuffer(message, HEAD_DTYPE, 1, len(CDR))[0]
        key = (int(row["register"]), int(row["number"]))
        data = made.get(key)
        if data is None:
            data = life.schema.group(message)
        begin = message[len(CDR) : _HEAD_END]
        total = RECORD.size + len(begin) + len(data)
        parts += [RECORD.pack(total, 0, len(data), 0, 0, 0)]
        parts += [begin, data]
    return parts
