"""Every cycle of every task of one run in virtual time, in memory.

A run in real time is recorded into a log (`pbonet.log`), which tells the same about it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.log import COLUMNS, Cycles
from pbonet.svar import group_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from pbonet.config import Variable


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
        self.end_ns = 0
        """When the last cycle ended."""
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
        self.end_ns = end_ns or release_ns
        row = (release_ns, cycle, start_ns, end_ns, cpu_ns, flags)
        self._heads += np.array(row, np.int64).tobytes()
        self._data += data

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


class Recording(Cycles):
    """Every cycle of a run, by task.

    Args:
        about: What should be known about the run: job, machine, start, statuses.
    """

    def __init__(self, about: Mapping[str, Any] | None = None) -> None:
        self.about = dict(about or {})
        self._tasks: dict[str, TaskRecord] = {}

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
        return list(self._tasks)

    def arrays(self, task: str) -> dict[str, NDArray[Any]]:
        """Return the columns and variables of a task, by name.

        Raises:
            KeyError: There is no such task.
        """
        return self._tasks[task].arrays()

    def variables(self, task: str) -> list[str]:
        """Return the variables that a task wrote.

        Raises:
            KeyError: There is no such task.
        """
        return self._tasks[task].names
