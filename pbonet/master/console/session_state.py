"""What a command finds of the interface that gave it: default task, columns, memory.

Each interface to a subsystem has its own (Stewart 1994, section 4.4.1). What reads
commands and carries them out is built on it: `pbonet.master.console.command_session`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import UnknownTaskError, did_you_mean
from pbonet.master.subsystem import status_fields

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.master.subsystem import Subsystem


class Seat:
    """The state of one interface.

    Args:
        subsystem: What it steers.
        hand_over: Called with a port name to let a program on the network steer; None
            where this interface cannot do that.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        *,
        hand_over: Callable[[str], None] | None = None,
    ) -> None:
        self.subsystem = subsystem
        self.hand_over = hand_over
        self.default = ""
        """The task that the last command was for."""
        self.shown: tuple[str, ...] = status_fields.DEFAULT
        self.baselines = status_fields.Baselines()
        self.ended = False
        """Set by `quit`."""

    @property
    def prompt(self) -> str:
        """The prompt of section 4.4.1: subsystem and default RMOD."""
        return f"SBS {self.subsystem.name}<{self.default}> "

    # -- tasks ------------------------------------------------------------------------

    def point_at(self, task: str) -> None:
        """Make `task` the default of the next command."""
        self.default = task

    def task(self, named: str | None, meant: str | None = None) -> str:
        """Return the task a command is for, and make it the default.

        Args:
            named: The task that was named.
            meant: A word that may have been meant as one, for the error.

        Raises:
            UnknownTaskError: None was named, and there is no default.
        """
        task = named or self.default
        if not task:
            raise _no_task(meant or "", self.subsystem.picture.names)
        self.default = task
        return task

    def tasks(self, named: list[str]) -> list[str]:
        """Return the tasks a command is for; the default when none is named.

        Raises:
            UnknownTaskError: None was named, and there is no default.
        """
        tasks = list(dict.fromkeys(named)) or [self.task(None)]
        self.default = tasks[-1]
        return tasks


def _no_task(word: str, known: list[str]) -> UnknownTaskError:
    """Return the error for a command that needs a task and has none."""
    return UnknownTaskError(
        f"the subsystem has no task {word}" if word else "no task is named",
        got="tasks: " + (", ".join(known) or "none"),
        remedy=did_you_mean(word, known) or "name one, or 'spawn' one first",
    )
