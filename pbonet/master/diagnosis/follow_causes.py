"""Follows a cause to the next one, each task, variable and RTPU once."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from .cause_chain import Cause, Source

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .facts import Facts

Told: TypeAlias = "tuple[str, list[Cause]]"
"""How something is, and why."""


class Chain:
    """The facts, and what was explained already on the way to a cause.

    Tasks may read each other's variables in a circle; each is explained where it is
    met first.

    Args:
        facts: What is known.
        parts: What explains a ``task``, a ``variable``, an ``rtpu`` and a ``miss``.
    """

    def __init__(
        self, facts: Facts, parts: Mapping[str, Callable[[Chain, str], Told]]
    ) -> None:
        self.facts = facts
        self._parts = parts
        self._met: set[tuple[str, str]] = set()

    def explained(self, kind: str, name: str) -> Told:
        """Return how a task, variable or RTPU is, and why; once for each."""
        if (kind, name) in self._met:
            return f"{name} (explained above)", []
        self._met.add((kind, name))
        return self._parts[kind](self, name)

    def behind(self, kind: str, name: str, source: Source, remedy: str = "") -> Cause:
        """Return something as a cause, with what explains it.

        Args:
            kind: One of the parts.
            name: Its name.
            source: Where it was read.
            remedy: What to do where none of its own causes has a remedy.
        """
        what, causes = self.explained(kind, name)
        known = any(map(_has_remedy, causes))
        return Cause(
            what=what,
            source=source,
            because=tuple(causes),
            remedy="" if known else remedy,
        )


def _has_remedy(cause: Cause) -> bool:
    return bool(cause.remedy) or any(map(_has_remedy, cause.because))
