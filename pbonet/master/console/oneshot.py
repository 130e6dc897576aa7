"""One command from outside a master: the verbs of the command line.

A verb that only shows something claims nothing. A verb that changes something is a
master for a moment: it claims the subsystem, acts, and leaves, and the tasks continue.
If a living master serves the port with the subsystem's name (``pbonet run`` does), that
master carries it out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import PbonetError
from pbonet.master.subsystem import Subsystem
from pbonet.xm.net import session

from .command_session import Call, CommandSession, Reply, convert
from .commands import find

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from pbonet.master.configuration import Place


def run(
    path: str | Path, command: str, args: Mapping[str, object], place: Place
) -> Reply:
    """Carry out one command on a subsystem and leave it.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        command: The command's name.
        args: Its arguments, by name.
        place: Where the subsystem is.

    Raises:
        PbonetError: A file, an argument or an agent is wrong, or the command failed.
    """
    wanted = find(command)
    return perform(path, Call(wanted, convert(wanted, args)), place)


def _unseen(_: Subsystem) -> None:
    """Take no note of the subsystem."""


def perform(
    path: str | Path,
    call: Call,
    place: Place,
    *,
    kind: str = "",
    begun: Callable[[Subsystem], None] = _unseen,
) -> Reply:
    """Carry out one command, whose arguments were read, and leave the subsystem.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        call: The command.
        place: Where the subsystem is.
        kind: What gives it, as agents and logs name it; the command if left out.
        begun: Called with the subsystem before it is opened; who sets its `stopped`
            ends a wait of the command.

    Raises:
        PbonetError: A file or an agent is wrong, or the command failed.
    """
    wanted = call.command
    opening: list[str] = []
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind=kind or wanted.name.replace(" ", "-"),
        watch=not call.changes,
        partly=not wanted.whole,
        warned=opening.append,
    )
    opened = session.client(place.domain, connect=place.connect)
    if call.changes and not place.take_over:
        from .ask_master import through_master

        reply = through_master(opened, place, subsystem.files, call, kind)
        if reply is not None:
            return reply
    begun(subsystem)
    try:
        subsystem.open(opened, once=True, task=call.task)
        reply = CommandSession(subsystem).perform(call)
    except PbonetError as error:
        for warning in dict.fromkeys(opening):
            error.add_note(warning)
        raise
    finally:
        subsystem.detach()
    warnings = list(dict.fromkeys([*opening, *reply.warnings]))
    return Reply(command=reply.command, data=reply.data, warnings=warnings)
