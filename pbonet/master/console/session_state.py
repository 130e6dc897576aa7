"""State that an interface keeps between two commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.master.subsystem import status_fields

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.master.subsystem import Subsystem


class SessionState:
    """The subsystem of an interface, its default task, and its columns.

    Args:
        subsystem: The subsystem that the commands are for.
        hand_over: Called with a port name to let a program on the network take control;
            None where this interface cannot do that.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        *,
        hand_over: Callable[[str], None] | None = None,
    ) -> None:
        self.subsystem: Subsystem = subsystem
        self.hand_over = hand_over
        self.default = ""
        """The task that the last command was for."""
        self.shown: tuple[str, ...] = status_fields.DEFAULT
        self.baselines = status_fields.Baselines()
        self.ended = False
        """Set by `quit`."""
