"""Recorded outputs of chosen tasks in a live table, while the other tasks run.

Each of them has a local table here, as the task had, and owns its variables as long as
it plays: no other task may write them then, and it cannot take what a task owns.
"""

from __future__ import annotations

import heapq
import os
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct

from pbonet.errors import LogError, SvarLayoutError, UnknownVariableError
from pbonet.log import Log, Step, StepSchema, head, unpack
from pbonet.svar import Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pbonet.config import Variable
    from pbonet.log import TaskLife

PREFIX: Final = "replay:"
"""Prefix of a task's name in the table while its record is played."""


class Played(Struct, kw_only=True):
    """The result for one task."""

    task: str
    commits: int = 0
    """Recorded ones that went into the table."""
    refused: int = 0
    """Values that the table refused: not finite, or outside LIMIT."""
    late: float = 0.0
    """Seconds by which the latest one was late."""

    def __str__(self) -> str:
        """Return it in one line."""
        refused = f", {self.refused} refused" if self.refused else ""
        late = f"at most {self.late * 1e3:.1f} ms late"
        return f"{self.task}: {self.commits} commits, {late}{refused}"


class Span(Struct, frozen=True, kw_only=True):
    """Which part of a run is played, and how fast."""

    rate: float = 1.0
    start: float = 0.0
    """Seconds since the run began."""
    end: float | None = None
    loop: bool = False
    """Begin again at the end, until it is stopped."""


class _Source:
    """One task's commits: when, and with which values.

    Args:
        log: The run.
        task: The task.
    """

    def __init__(self, log: Log, task: str) -> None:
        self.task = task
        lives = log.lives(task)
        self.variables = {
            v.name: v
            for life in lives
            for v in life.about.outvar
            if v.name not in life.about.hidden
        }
        self.consts = {v.name: v for life in lives for v in life.about.outconst}
        self.times: NDArray[np.int64] = np.zeros(0, np.int64)
        self._rows: list[tuple[int, int]] = []
        self._lives: list[dict[str, NDArray[Any]]] = []
        self._sent: list[tuple[int, list[Variable], bytes]] = []
        for life in lives:
            self._add(life)
        order = np.argsort(self.times, kind="stable")
        self.times = self.times[order]
        self._rows = [self._rows[i] for i in order]
        if not len(self.times):
            raise LogError(
                f"the log has no cycle of {task}",
                where=str(log.path),
                expected="a task that was ON",
                remedy="see `pbonet log info`",
            )

    def _add(self, life: TaskLife) -> None:
        arrays = life.schema.arrays(life.commits)
        first = len(self._lives)
        self._lives.append(arrays)
        self._rows += [(first, row) for row in range(len(life.commits))]
        self.times = np.concatenate([self.times, self._moved(life, arrays["end_ns"])])
        for message in life.steps:
            found = head(message)
            if found["kind"] == Step.CONSTS_OUT:
                data = StepSchema.data(message)
                end = int(found["end_ns"])
                at = end + life.moves.one(end)
                self._sent.append((at, life.about.outconst, data))

    @staticmethod
    def _moved(life: TaskLife, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return instants as nanoseconds since 1970, by the clock of all."""
        return times + life.moves.of(times)

    def row_at(self, time_ns: int) -> int:
        """Return the last commit up to a time; the first one if there is none."""
        return max(int(np.searchsorted(self.times, time_ns, side="right")) - 1, 0)

    def fill(self, row: int, arrays: dict[str, NDArray[Any]]) -> int:
        """Put the values of one commit where they go; return its cycle."""
        life, at = self._rows[row]
        values = self._lives[life]
        for name, to in arrays.items():
            if name in values:
                to[...] = values[name][at]
        return int(values["cycle"][at])

    def fill_consts(self, time_ns: int, arrays: dict[str, NDArray[Any]]) -> None:
        """Put the constants where they go, as they were last up to a time."""
        for at, variables, data in self._sent:
            if at <= time_ns or at == self._sent[0][0]:
                unpack(variables, data, arrays.__getitem__)


class _Voice:
    """One task's part in the table.

    Args:
        source: What it says.
        table: Where.
    """

    def __init__(self, source: _Source, table: Table) -> None:
        self.source = source
        self.result = Played(task=source.task)
        _check_fit(table, [*source.variables.values(), *source.consts.values()])
        self.local = table.local(
            f"{PREFIX}{source.task}",
            os.getpid(),
            outvar=list(source.variables),
            outconst=list(source.consts),
        )
        self._arrays = {name: self.local.array(name) for name in source.variables}
        self._consts = {name: self.local.array(name) for name in source.consts}

    def take_over(self, time_ns: int) -> None:
        """Give the constants and own the variables.

        Raises:
            SvarOwnerError: A task owns one of them, or gives a constant another value.
        """
        if self._consts:
            self.source.fill_consts(time_ns, self._consts)
            self.local.copy_out_consts()
        self.local.check_claim()
        row = self.source.row_at(time_ns)
        self.local.claim(0, self.source.fill(row, self._arrays))

    def say(self, row: int, late: float) -> None:
        """Commit the recorded values."""
        cycle = self.source.fill(row, self._arrays)
        owned = self.local.claimed  # not where its first values were refused
        send = self.local.commit if owned else self.local.claim
        if send(time.monotonic_ns(), cycle):
            self.result.refused += 1
        else:
            self.result.commits += 1
        self.result.late = max(self.result.late, late)


def play(
    path: str | Path,
    tasks: Sequence[str],
    span: Span | None = None,
    *,
    domain: str = "default",
    subsystem: str = "",
) -> list[Played]:
    """Play what tasks committed into a table, at the times at which they did.

    An interrupt ends it; the values then remain, as after a task is turned off.

    Args:
        path: The log, or the folder of a run.
        tasks: Whose outputs.
        span: Which part, and how fast.
        domain: Of the agents.
        subsystem: Where it is played; that of the log if empty.

    Raises:
        LogError: There is no log, or it has no cycle of a task, or none in that part.
        UnknownTaskError: The log has no such task.
        SvarMissingError: The subsystem does not run on this machine.
        SvarLayoutError: A variable is another one in that table.
        SvarOwnerError: A task owns one of the variables.
    """
    span, log = span or Span(), Log(path)
    table = f"{domain}.{subsystem or log.about.get('subsystem', '')}"
    sources = [_Source(log, task) for task in dict.fromkeys(tasks)]
    begin = log.begin_time_ns
    first = begin + round(span.start * 1e9)
    ends = [int(source.times[-1]) for source in sources]
    last = max(ends) if span.end is None else begin + round(span.end * 1e9)
    rows = [_Cut(source, first, last) for source in sources]
    if not any(len(one) for one in rows):
        raise LogError(
            "the log has no commit of these tasks in that time",
            where=str(log.path),
            expected=f"less than {(max(ends) - begin) * 1e-9:.1f} s to begin with",
            got=f"{span.start:g} s to {(last - begin) * 1e-9:g} s",
            remedy="choose another start or end",
        )
    with ExitStack() as stack:
        live = stack.enter_context(Table.attach(table))
        voices: list[_Voice] = []
        for source in sources:
            voices.append(_Voice(source, live))
            stack.enter_context(voices[-1].local)
        try:
            for voice in voices:
                voice.take_over(first)
            _go(voices, rows, span, (first, last))
        except KeyboardInterrupt:
            pass
        return [voice.result for voice in voices]


class _Cut:
    """The commits of one task within a time."""

    def __init__(self, source: _Source, first: int, last: int) -> None:
        self._times = source.times
        self._begin = int(np.searchsorted(source.times, first, side="left"))
        self._end = int(np.searchsorted(source.times, last, side="right"))

    def __len__(self) -> int:
        return max(self._end - self._begin, 0)

    def items(self, number: int) -> Iterator[tuple[int, int, int]]:
        """Yield time, number of the task, and row."""
        for row in range(self._begin, self._end):
            yield int(self._times[row]), number, row


def _go(
    voices: list[_Voice], rows: list[_Cut], span: Span, times: tuple[int, int]
) -> None:
    """Commit each at its time, once or over and over."""
    first, last = times
    begun = time.monotonic()
    while True:
        each = [cut.items(number) for number, cut in enumerate(rows)]
        for time_ns, number, row in heapq.merge(*each):
            due = begun + (time_ns - first) * 1e-9 / span.rate
            wait = due - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            voices[number].say(row, max(time.monotonic() - due, 0.0))
        if not span.loop:
            return
        begun += (last - first) * 1e-9 / span.rate


def _check_fit(table: Table, variables: list[Variable]) -> None:
    """Refuse variables that mean something else in the table.

    Raises:
        SvarLayoutError: One does, or is not there.
    """
    for variable in variables:
        try:
            there = table.variable(variable.name)
        except UnknownVariableError as error:
            raise SvarLayoutError(
                f"the table has no {variable.name}, which was recorded",
                where=table.name,
                expected=_meaning(variable),
                remedy=error.remedy,
            ) from None
        if _meaning(there) != _meaning(variable):
            raise SvarLayoutError(
                f"{variable.name} differs between the table and the log",
                where=table.name,
                expected=_meaning(variable),
                got=_meaning(there),
                remedy="play it into a subsystem whose .svar file defines it in the "
                "same way",
            )


def _meaning(variable: Variable) -> str:
    return f"{variable.type}[{variable.nelem}] in {variable.units}"
