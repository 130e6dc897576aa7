"""The autonomous interface: control by a program (Stewart 1994, 4.4.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.master import subsystem

from .commands import COMMANDS, Command, find
from .interfaces import serve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.master.diagnosis import Explanation


class Subsystem(subsystem.Subsystem):
    """A subsystem of tasks on one or more RTPUs, controlled by this program.

    It has a method for every command; `help` lists them. Arguments and errors are those
    of its base class.
    """

    def network(self, portname: str) -> None:
        """Hand control to a program on the network until it ends (`sbsNetwork`).

        Raises:
            NodeError: The name cannot be one.
            DuplicateNameError: Another master serves a port of this name.
        """
        serve(self, portname)

    def explain(
        self, what: str | Sequence[str] = (), *, trace: float = 0.0
    ) -> Explanation:
        """Explain why something is as it is: the causes, and what to do.

        It asks the agents, disturbs no task, and judges what it could read.

        Args:
            what: ``flag``, also if left out, a task, a variable, an RTPU, ``start
                [JOB]``, or ``miss TASK [CYCLE]``; one text, or its words.
            trace: With ``miss TASK``: wait so many seconds at most for its next miss,
                while the kernel says which thread has the core (root only).

        Returns:
            The chain of causes; `str` of it is what the command shows.

        Raises:
            StateError: It asks nothing that can be explained, or nothing has that name.
        """
        from pbonet.master import diagnosis

        words = what.split() if isinstance(what, str) else what
        return diagnosis.answer_of(self, words, trace=trace)

    def help(self, command: str | None = None) -> tuple[Command, ...]:
        """Return the table of commands, or one of them.

        Raises:
            NodeError: There is no such command.
        """
        return COMMANDS if command is None else (find(command),)
