"""A module's information about its own task, in a run and in a replay of it.

A handler of timing failures interrupts its module anywhere, so its requests have no
place among those of the cycle: it has a separate source.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from ._tape import ALWAYS, Outside

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


class ModuleAnswers:
    """Asks on behalf of a module, and of its handler of timing failures.

    Args:
        timing: Whether the handler has its own source; older logs have none.
    """

    def __init__(self, *, timing: bool = True) -> None:
        self._plain = Outside("task")
        self.timing = Outside("timing failures") if timing else self._plain
        self.handling = False
        """Whether the handler runs."""
        self._last: dict[tuple[bool, str], object] = {}

    def ask(self, call: Callable[[], T], default: object = ALWAYS) -> T:
        """Return what a question is answered; see `Outside.ask`."""
        source = self.timing if self.handling else self._plain
        return source.ask(call, default=default)

    def now(self, what: str, call: Callable[[], T], first: T) -> T:
        """Return what changes now and then: only a new answer needs a record.

        Args:
            what: Which question it is.
            call: Answers it.
            first: What needs no record the first time.
        """
        key = self.handling, what
        value = self.ask(call, default=self._last.get(key, first))
        self._last[key] = value
        return value
