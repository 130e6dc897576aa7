"""Every cycle of a run by task, from a file or from memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbonet.errors import UnknownVariableError, did_you_mean

if TYPE_CHECKING:
    from numpy.typing import NDArray

COLUMNS: Final = ("release_ns", "cycle", "start_ns", "end_ns", "cpu_ns", "flags")
"""Columns of a cycle besides its values: times of CLOCK_MONOTONIC, its number, CPU
time (all in nanoseconds), and the flags of its copies."""
STABLE: Final = 1 << 31
"""The flag of a cycle in which ``stable`` ran."""


class Cycles(ABC):
    """Every cycle of a run, by task."""

    about: dict[str, Any]
    """The run: job, machine, start."""

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

    def missed(self) -> dict[str, int]:
        """Return how many releases each task has missed, if they were counted."""
        return {}

    def lost(self) -> dict[str, int]:
        """Return how many records of each task did not fit its ring."""
        return {}

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

        Returns:
            The releases of the writer's cycles, shape ``(n,)``, in seconds; and the
            values, shape ``(n, ...)`` with the variable's own shape last, in its unit.

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
