"""Every cycle of every task of one run in virtual time, in memory.

A run in real time is recorded into a log (`pbonet.log`), which tells the same about it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.log import COLUMNS, HELD, SAFE, STABLE, Cycles, Step
from pbonet.node.ring import parse
from pbonet.svar import group_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from pbonet.log import TaskAbout


class TaskRecord:
    """The cycles of one task, appended as they come out of its ring.

    Args:
        about: What the ring holds.
    """

    def __init__(self, about: TaskAbout) -> None:
        group = group_of(about.outvar, range(len(about.outvar)))
        self._fields = list(zip(about.outvar, group.at, strict=True))
        self._size = group.bytes
        self._heads = bytearray()
        self._data = bytearray()
        self._base = 0
        """How many cycles it had when it was turned on."""
        self.drain: Callable[[], None] = lambda: None
        """Has what is in the ring added."""

    @property
    def names(self) -> list[str]:
        """The variables that the task writes."""
        return [variable.name for variable, _ in self._fields]

    @property
    def units(self) -> dict[str, str]:
        """The unit of each of them."""
        return {variable.name: variable.units for variable, _ in self._fields}

    def add(self, text: bytes) -> None:
        """Append the cycles among the records of a ring."""
        for one in parse(text):
            if one.kind == Step.ON_IN:
                self._base = one.cycle
            elif one.kind == Step.CYCLE:
                number = one.cycle - self._base
                times = one.start_ns, one.end_ns, one.cpu_ns
                flags = (STABLE * one.stable) | (one.flags & (HELD | SAFE))
                row = (one.release_ns, number, *times, flags)
                self._heads += np.array(row, np.int64).tobytes()
                self._data += one.data

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all columns and variables, by name."""
        self.drain()
        heads = np.frombuffer(bytes(self._heads), np.int64).reshape(-1, len(COLUMNS))
        data = np.frombuffer(bytes(self._data), np.uint8)
        rows = data.reshape(len(heads), self._size)
        found: dict[str, NDArray[Any]] = {
            name: heads[:, i].copy() for i, name in enumerate(COLUMNS)
        }
        for variable, at in self._fields:
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

    def task(self, name: str, about: TaskAbout) -> TaskRecord:
        """Return the record of a task, made when it is asked for first."""
        record = self._tasks.get(name)
        if record is None:
            record = self._tasks[name] = TaskRecord(about)
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

    def unit(self, variable: str) -> str:
        """Return the unit of a variable; empty if no task writes it."""
        each = (task.units for task in self._tasks.values())
        return next((units[variable] for units in each if variable in units), "")
