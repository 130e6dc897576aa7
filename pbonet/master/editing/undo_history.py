"""States that an editor can go back to, and forward to again."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

State = TypeVar("State")

LONGEST = 200
"""Number of changes that can be taken back; older ones are forgotten."""


class History(Generic[State]):
    """The states of something that is edited, each with the change that made it.

    Args:
        first: The state to begin with.
    """

    def __init__(self, first: State) -> None:
        self.now = first
        self._before: deque[tuple[str, State]] = deque(maxlen=LONGEST)
        self._after: list[tuple[str, State]] = []

    @property
    def undo_label(self) -> str:
        """The change that `undo` takes back; empty: there is none."""
        return self._before[-1][0] if self._before else ""

    @property
    def redo_label(self) -> str:
        """The change that `redo` makes again; empty: there is none."""
        return self._after[-1][0] if self._after else ""

    def add(self, label: str, state: State) -> None:
        """Go to a new state; what was taken back before is forgotten."""
        self._before.append((label, self.now))
        self._after.clear()
        self.now = state

    def undo(self) -> bool:
        """Go back one change; False: there is none."""
        if not self._before:
            return False
        label, state = self._before.pop()
        self._after.append((label, self.now))
        self.now = state
        return True

    def redo(self) -> bool:
        """Go forward one change that was taken back; False: there is none."""
        if not self._after:
            return False
        label, state = self._after.pop()
        self._before.append((label, self.now))
        self.now = state
        return True
