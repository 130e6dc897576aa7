"""A module's view of time in a real task: `pbonet.pbo.Watch` over its slot."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.pbo import (
    TaskContext,
    check_criticality,
    check_deadline,
    check_section,
)

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from pbonet.node.rt import Failures
    from pbonet.outside import ModuleAnswers


class SlotWatch:
    """The watch of a task that the dispatcher supervises.

    Args:
        failures: The native half, which notifies the dispatcher.
    """

    told: ModuleAnswers
    """Records the values that the module gets from here."""

    def __init__(self, failures: Failures) -> None:
        self._failures = failures
        self._sections: dict[str, AbstractContextManager[None]] = {}
        self.task = TaskContext()

    @property
    def criticality(self) -> int:
        """The task's current criticality."""
        return self.told.now("criticality", self.ranked, -1)

    @criticality.setter
    def criticality(self, value: int) -> None:
        self._failures.criticality = check_criticality(self.task, value)

    @property
    def deadline(self) -> float:
        """Seconds from the release of this cycle to its deadline."""
        return self.told.now("deadline", self._due, -1.0)

    @deadline.setter
    def deadline(self, value: float) -> None:
        self._failures.deadline = check_deadline(self.task, value)

    def critical(self) -> AbstractContextManager[None]:
        """Return a context manager that defers timing failures and their effects."""
        return self._failures.section

    def timed(self, name: str) -> AbstractContextManager[None]:
        """Return a context manager that measures the CPU time of section `name`.

        Raises:
            MethodError: The name is invalid, or there is no room for another.
        """
        found = self._sections.get(name)
        if found is None:
            check_section(name, self._sections, where=self.task.name)
            found = self._sections[name] = self._failures.timed(name)
        return found

    def ranked(self) -> int:
        """Return the current criticality, without recording it."""
        return self._failures.criticality

    def _due(self) -> float:
        return self._failures.deadline
