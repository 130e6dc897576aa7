"""Warnings that are given once, until the reason has gone or is another."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pbonet import TaskContext


class WarnOnce:
    """Warns of a lasting state once.

    Args:
        task: Of the module.
    """

    def __init__(self, task: TaskContext) -> None:
        self._task, self._kind = task, ""

    def warn(self, kind: str, text: str) -> None:
        """Warn, unless the last warning was of the same kind."""
        if kind != self._kind:
            self._task.warn(text)
        self._kind = kind

    def of(self, kind: str) -> bool:
        """Return whether the last warning was of this kind."""
        return kind == self._kind

    def clear(self, *kinds: str) -> None:
        """Forget the last warning, if it was of one of these kinds; or of any."""
        if not kinds or self._kind in kinds:
            self._kind = ""
