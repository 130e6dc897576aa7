"""The autonomous interface: control by a program (Stewart 1994, 4.4.4)."""

from __future__ import annotations

from pbonet.master import subsystem

from .commands import COMMANDS, Command, find
from .interfaces import serve


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

    def help(self, command: str | None = None) -> tuple[Command, ...]:
        """Return the table of commands, or one of them.

        Raises:
            NodeError: There is no such command.
        """
        return COMMANDS if command is None else (find(command),)
