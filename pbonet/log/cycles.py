"""Every cycle of a run by task, from a file or from memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pbonet.errors import UnknownVariableError, did_you_mean

from .series import Series

if TYPE_CHECKING:
    from numpy.typing import NDArray

COLUMNS: Final = ("release_ns", "cycle", "start_ns", "end_ns", "cpu_ns", "flags")
"""Columns of a cycle besides its values: times of CLOCK_MONOTONIC, its number, CPU
time (all in nanoseconds), and the flags of its copies."""


class Written(NamedTuple):
    """Values that one task wrote to a variable."""

    task: str
    releases: NDArray[np.int64]
    """The releases of its cycles, CLOCK_MONOTONIC nanoseconds, shape ``(n,)``."""
    values: NDArray[Any]
    """Shape ``(n, ...)``."""


class Cycles(ABC):
    """Every cycle of a run, by task."""

    about: dict[str, Any]
    """The run: job, machine, start."""
    where: str = ""
    """Its file, for errors; empty: it has none."""

    @property
    @abstractmethod
    def tasks(self) -> list[str]:
        """The names of the tasks."""

    @abstractmethod
    def arrays(self, task: str) -> dict[str, NDArray[Any]]:
        """Return the columns and variables of a task, by name.

        Raises:
            KeyError: There is no such task.
        """

    @abstractmethod
    def variables(self, task: str) -> list[str]:
        """Return the variables that a task wrote.

        Raises:
            KeyError: There is no such task.
        """

    @property
    def only_last(self) -> bool:
        """Whether only the last seconds before each error were to be recorded."""
        return False

    def missed(self) -> dict[str, int]:
        """Return how many releases each task has missed, if they were counted."""
        return {}

    def failed(self) -> dict[str, int]:
        """Return how many cycles of each task ended in an error, if counted."""
        return {}

    def lost(self) -> dict[str, int]:
        """Return how many records of each task are missing, if counted."""
        return {}

    def written(self, variable: str) -> list[Written]:
        """Return what each task wrote to a variable, in the order of the tasks.

        Of several subsystems with such a variable it is that of the first task.

        Raises:
            UnknownVariableError: No task of the run wrote it.
        """
        found = [
            Written(task, arrays["release_ns"], arrays[variable])
            for task in self.tasks
            if variable in self.variables(task)
            for arrays in [self.arrays(task)]
        ]
        self.must_be_written(variable, bool(found))
        return found

    def must_be_written(self, variable: str, found: object) -> None:
        """Refuse a variable that no task wrote.

        Raises:
            UnknownVariableError: `found` is false.
        """
        if found:
            return
        known = list(
            dict.fromkeys(name for task in self.tasks for name in self.variables(task))
        )
        raise UnknownVariableError(
            f"no task of the run wrote {variable}",
            where=self.where,
            expected=" or ".join(known) or "a run with tasks",
            remedy=did_you_mean(variable, known) or "name one that was written",
        )

    def unit(self, variable: str) -> str:
        """Return the unit of a variable that a task wrote; empty if it is not known."""
        del variable
        return ""

    def series(self, variable: str) -> Series:
        """Return a variable over time: seconds since the run began, and its values.

        The values of all its writers are included, as after a swap; see `writers`.

        Returns:
            A pair that can be plotted: the releases of the writers' cycles, shape
            ``(n,)``, in seconds; and the values, shape ``(n, ...)`` with the variable's
            own shape last, in its unit.

        Raises:
            UnknownVariableError: No task of the run wrote it.
        """
        each = self.written(variable)
        releases = np.concatenate([one.releases for one in each])
        values = np.concatenate([one.values for one in each])
        order = np.argsort(releases, kind="stable")
        seconds = (releases[order] - self.begin_ns).astype(np.float64) * 1e-9
        pair = seconds, values[order]
        writers = partial(self.writers, variable)
        return Series.of(pair, variable, self.unit(variable), writers)

    def writers(self, variable: str) -> list[tuple[float, str]]:
        """Return the tasks that wrote a variable, each time that the writer changed.

        Returns:
            When each of them began to write, in seconds since the run began, and its
            name; by time. A task is listed again if it took the variable over again.

        Raises:
            UnknownVariableError: No task of the run wrote it.
        """
        each = self.written(variable)
        releases = np.concatenate([one.releases for one in each])
        who = np.repeat(np.arange(len(each)), [len(one.releases) for one in each])
        order = np.argsort(releases, kind="stable")
        releases, who = releases[order], who[order]
        found: list[tuple[float, str]] = []
        places: list[int] = np.flatnonzero(np.diff(who, prepend=-1)).tolist()
        for at in places:
            begin = (int(releases[at]) - self.begin_ns) * 1e-9
            task = each[int(who[at])].task
            if not found or found[-1][1] != task:  # else it was spawned again
                found.append((begin, task))
        return found

    @property
    def begin_ns(self) -> int:
        """The first release of any task."""
        firsts = [
            int(releases[0])
            for task in self.tasks
            if len(releases := self.arrays(task)["release_ns"])
        ]
        return min(firsts, default=0)
