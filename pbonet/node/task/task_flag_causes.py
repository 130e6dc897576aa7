"""A task's own entries in the illegal-configuration flag (Stewart 1994, 3.10)."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from pbonet.errors import SvarError, SvarOwnerError
from pbonet.pbo import Signal

if TYPE_CHECKING:
    from pbonet.pbo import TaskContext
    from pbonet.svar import Table


class TaskFlagCauses:
    """Causes that a task has raised, by its module or because its inputs are stale.

    All are withdrawn when the task is no longer ON, and when its process ends.

    Args:
        table: The table with the flag.
        raiser: The task, with its RTPU.
        task: The module's context, to which a hook is added; also used for reports.
    """

    def __init__(self, table: Table, raiser: str, task: TaskContext) -> None:
        self._table = table
        self._raiser = raiser
        self._task = task
        self._causes: set[str] = set()
        self._aged = ""
        task.on_illegal = self._said

    def aged(self, cause: str) -> None:
        """Raise or change the entry for stale inputs; an empty cause withdraws it."""
        if cause == self._aged:
            return
        before, self._aged = self._aged, cause
        if cause:
            self._raise(cause)
            self._task.announce(Signal.ILLEGAL, cause)
        if before:
            self._clear(before)
        if not cause:
            self._task.announce(Signal.LEGAL, before)

    def end(self) -> None:
        """Withdraw all causes; no effect if there are none."""
        self.aged("")
        for cause in list(self._causes):
            self._said(cause, up=False)

    def _said(self, cause: str, *, up: bool) -> None:
        """Raise or withdraw a cause for the module; an empty one withdraws all."""
        if up:
            self._causes.add(cause)
            self._raise(cause)
            return
        for one in [cause] if cause else list(self._causes):
            self._causes.discard(one)
            self._clear(one)

    def _raise(self, cause: str) -> None:
        with contextlib.suppress(SvarError):  # no room: other causes keep the flag up
            self._table.raise_illegal(cause, self._raiser)

    def _clear(self, cause: str) -> None:
        with contextlib.suppress(SvarOwnerError):
            self._table.clear_illegal(self._raiser, cause)
