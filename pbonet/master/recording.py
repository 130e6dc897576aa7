"""Every cycle of every task of one run, and the ``.npz`` file they are kept in.

A run in real time fills a `Recording` from the tasks' rings, the simulator from its own
table; plots, summaries and comparisons then do not care which it was. For long runs
there is the log (`pbonet.log`), which is written while the run goes on.

The file holds, for each task, the arrays ``task/release_ns``, ``task/cycle`` and the
other columns of `COLUMNS` with one element a cycle, ``task/VARIABLE`` with one row a
cycle for each variable the task writes, and ``about`` with JSON text.
"""

from __future__ import annotations

import json
import os
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast
from zipfile import BadZipFile

import numpy as np

from pbonet.errors import ConfigFileError, UnknownVariableError, did_you_mean
from pbonet.svar.layout import group_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from pbonet.config.model import Variable
    from pbonet.node._ring import Record

COLUMNS: Final = ("release_ns", "cycle", "start_ns", "end_ns", "cpu_ns", "flags")
"""What is known of a cycle beside its values: instants of CLOCK_MONOTONIC, its number,
CPU time, and the flags of its copies."""
STABLE: Final = 1 << 31
"""The flag of a cycle in which ``stable`` ran."""


_UNREADABLE: Final = (
    *(OSError, ValueError, KeyError, AttributeError, TypeError, EOFError),
    *(BadZipFile, zlib.error, RuntimeError, MemoryError),
)
"""What numpy and zipfile raise for a file that is no recording."""


def _unwritable(path: str | Path, why: str) -> ConfigFileError:
    return ConfigFileError(
        "the recording cannot be written",
        where=str(path),
        got=why,
        remedy="choose a folder that exists and may be written to",
    )


class TaskRecord:
    """The cycles of one task, appended as they come.

    Args:
        task: Its name.
        variables: All variables of the table, by index.
        outputs: The names of those that the task writes.
    """

    def __init__(
        self, task: str, variables: Sequence[Variable], outputs: Sequence[str]
    ) -> None:
        self.task = task
        numbers = [i for i, v in enumerate(variables) if v.name in set(outputs)]
        self._group = group_of(variables, numbers)
        self._variables = [variables[i] for i in self._group.indices]
        self._heads = bytearray()
        self._data = bytearray()

    @property
    def size(self) -> int:
        """Bytes of the group of out-variables that belongs to each cycle."""
        return self._group.bytes

    @property
    def names(self) -> list[str]:
        """The variables that the task writes."""
        return [variable.name for variable in self._variables]

    def __len__(self) -> int:
        """Return the number of cycles."""
        return len(self._heads) // (8 * len(COLUMNS))

    def add(
        self,
        data: bytes | memoryview,
        *,
        release_ns: int,
        cycle: int,
        start_ns: int = 0,
        end_ns: int = 0,
        cpu_ns: int = 0,
        flags: int = 0,
    ) -> None:
        """Append one cycle.

        Args:
            data: Its group of out-variables, as it was committed.
            release_ns: When it was released.
            cycle: Its number since the task was turned on.
            start_ns: When its first line ran.
            end_ns: When it was done.
            cpu_ns: CPU time it took.
            flags: Of its copies.
        """
        row = (release_ns, cycle, start_ns, end_ns, cpu_ns, flags)
        self._heads += np.array(row, np.int64).tobytes()
        self._data += data

    def take(self, records: Iterable[Record]) -> None:
        """Append cycles as they come out of the task's ring."""
        for record in records:
            self.add(
                record.data,
                release_ns=record.release_ns,
                cycle=record.cycle,
                start_ns=record.start_ns,
                end_ns=record.end_ns,
                cpu_ns=record.cpu_ns,
                flags=record.flags,
            )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all columns and variables, by name."""
        heads = np.frombuffer(bytes(self._heads), np.int64).reshape(-1, len(COLUMNS))
        data = np.frombuffer(bytes(self._data), np.uint8)
        rows = data.reshape(len(heads), self.size)
        found: dict[str, NDArray[Any]] = {
            name: heads[:, i].copy() for i, name in enumerate(COLUMNS)
        }
        for variable, at in zip(self._variables, self._group.at, strict=True):
            dtype = np.dtype(variable.dtype)
            part = rows[:, at : at + dtype.itemsize * variable.nelem]
            found[variable.name] = np.ascontiguousarray(part).view(dtype)
        return found


class Recording:
    """Every cycle of a run, by task.

    Args:
        about: What should be known about the run: job, machine, start, statuses.
    """

    def __init__(self, about: Mapping[str, Any] | None = None) -> None:
        self.about: dict[str, Any] = dict(about or {})
        self._tasks: dict[str, TaskRecord] = {}
        self._loaded: dict[str, dict[str, NDArray[Any]]] = {}

    def task(
        self, name: str, variables: Sequence[Variable], outputs: Sequence[str]
    ) -> TaskRecord:
        """Return the record of a task, made when it is asked for first."""
        record = self._tasks.get(name)
        if record is None:
            record = self._tasks[name] = TaskRecord(name, variables, outputs)
        return record

    @property
    def tasks(self) -> list[str]:
        """The names of the tasks."""
        return list(self._loaded or self._tasks)

    def arrays(self, task: str) -> dict[str, NDArray[Any]]:
        """Return the columns and variables of a task, by name.

        Raises:
            KeyError: There is no such task.
        """
        if task in self._loaded:
            return self._loaded[task]
        return self._tasks[task].arrays()

    def variables(self, task: str) -> list[str]:
        """Return the variables that a task wrote.

        Raises:
            KeyError: There is no such task.
        """
        if task in self._loaded:
            return [name for name in self._loaded[task] if name not in COLUMNS]
        return self._tasks[task].names

    def writer(self, variable: str) -> str:
        """Return the task that wrote a variable, the first one if there were several.

        Raises:
            UnknownVariableError: No task of the run wrote it.
        """
        known: dict[str, str] = {}
        for task in self.tasks:
            for name in self.variables(task):
                known.setdefault(name, task)
        if variable not in known:
            raise UnknownVariableError(
                f"no task of the run wrote {variable}",
                expected=" or ".join(known) or "a run with tasks",
                remedy=did_you_mean(variable, known) or "name one that was written",
            )
        return known[variable]

    def series(self, variable: str) -> tuple[NDArray[np.float64], NDArray[Any]]:
        """Return a variable over time: seconds since the run began, and its values.

        Raises:
            UnknownVariableError: No task of the run wrote it.
        """
        arrays = self.arrays(self.writer(variable))
        return (arrays["release_ns"] - self.begin_ns) * 1e-9, arrays[variable]

    @property
    def begin_ns(self) -> int:
        """The first release of any task."""
        firsts = [
            int(releases[0])
            for task in self.tasks
            if len(releases := self.arrays(task)["release_ns"])
        ]
        return min(firsts, default=0)

    @staticmethod
    def check_path(path: str | Path) -> None:
        """Refuse a file that cannot be written, before a run is made for it.

        Raises:
            ConfigFileError: It cannot.
        """
        path = Path(path).absolute()
        if path.is_dir():
            raise _unwritable(path, "a folder")
        if not path.parent.is_dir():
            raise _unwritable(path, f"no folder {path.parent}")
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise _unwritable(path, "Permission denied")

    def save(self, path: str | Path) -> None:
        """Write the file.

        Raises:
            ConfigFileError: It cannot be written.
        """
        content: dict[str, Any] = {"about": np.array(json.dumps(self.about))}
        for task in self.tasks:
            for name, values in self.arrays(task).items():
                content[f"{task}/{name}"] = values
        try:
            with Path(path).open("wb") as file:
                np.savez_compressed(file, **content)
        except OSError as error:
            raise _unwritable(path, error.strerror or str(error)) from None

    @staticmethod
    def load(path: str | Path) -> Recording:
        """Return the recording in a file.

        Raises:
            ConfigFileError: There is none, or it is not one.
        """
        try:
            with Path(path).open("rb") as file, np.load(file) as archive:
                content: dict[str, NDArray[Any]] = {k: archive[k] for k in archive}
            about = json.loads(str(content.pop("about")))
        except _UNREADABLE as error:
            raise ConfigFileError(
                "the recording cannot be read",
                where=str(path),
                expected="a file that `pbonet run --record` wrote",
                got=str(error),
                remedy="record the run again",
            ) from None
        recording = Recording(cast("dict[str, Any]", about))
        for key, values in content.items():
            task, _, name = key.partition("/")
            recording._loaded.setdefault(task, {})[name] = values
        return recording
