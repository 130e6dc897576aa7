"""Warnings about present conditions: each is reported once while it holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.analysis import legality

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


class WarningDedup:
    """Warnings already given about the tasks of a subsystem.

    A change is judged with all that stands, and so finds again what was found before.
    Said again at each command, it would hide what is new.
    """

    def __init__(self) -> None:
        self._told: set[str] = set()

    def new(self, problems: Iterable[legality.Problem]) -> list[legality.Problem]:
        """Return the warnings that were not given yet."""
        return [one for one in problems if legality.as_text(one) not in self._told]

    def say(self, problems: Iterable[legality.Problem]) -> list[str]:
        """Return new warnings as texts, and mark them as given."""
        new = list(map(legality.as_text, self.new(problems)))
        self._told |= set(new)
        return new

    def keep(self, problems: Sequence[legality.Problem]) -> None:
        """Forget warnings that no longer hold, so that they can be given again."""
        self._told &= set(map(legality.as_text, problems))


def refused(problems: Iterable[legality.Problem]) -> list[legality.Problem]:
    """Return those for which a change is refused."""
    return [one for one in problems if one.severity is legality.Severity.REFUSE]


def unwritten(problems: Iterable[legality.Problem]) -> list[legality.Problem]:
    """Return those that are about inputs which no task writes (equation 2)."""
    return [one for one in problems if one.code is legality.Code.NO_WRITER]
