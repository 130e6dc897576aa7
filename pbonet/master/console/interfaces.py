"""A master that runs its interfaces one after the other (Stewart 1994, 4.2).

What `main` of the thesis's master task is: open the subsystem, run the interface
commands (a script, the network, the prompt), finish.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from pbonet.errors import ConfigFileError, PbonetError
from pbonet.master.subsystem import Subsystem

from . import render
from .command_session import CommandSession, Reply
from .network_interface import Port
from .watch_values import Listener

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pbonet.master.configuration import Place
    from pbonet.xm.net import Event

STDIN: Final = "-"


def run(
    path: str | Path,
    place: Place,
    *,
    scripts: Sequence[str] = (),
    network: str | None = None,
    prompt: bool = True,
    leave: bool = False,
    keep_going: bool = False,
    as_data: bool = False,
    debug: bool = False,
) -> int:
    """Act as a subsystem's master while its interfaces run.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        place: Where the subsystem is.
        scripts: Files of commands, ``-`` for standard input; they come first.
        network: A port, which comes next.
        prompt: Whether the prompt comes last.
        leave: Leave the tasks as they are in the end, in place of stopping them.
        keep_going: Go on with a script after a command that failed.
        as_data: Print what scripts give as JSON, one object a line.
        debug: Show the stack of an error.

    Returns:
        The exit status: 1 when a command of a script failed.

    Raises:
        PbonetError: The subsystem cannot be opened, or not be ended.
    """
    texts = [(name, _read(name)) for name in scripts]
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind="sbs",
        warned=lambda text: render.print_error(render.warning(text)),
    )
    failed = False
    with subsystem:
        for name, text in texts:
            failed |= Script(
                subsystem, keep_going=keep_going, as_data=as_data, debug=debug
            ).run(name, text)
        if network is not None:
            serve(subsystem, network)
        if prompt:
            from .prompt import Prompt

            Prompt(subsystem, debug=debug).run()
        if leave:
            subsystem.detach()
    return int(failed)


def serve(subsystem: Subsystem, portname: str) -> None:
    """Let a program on the network take control until it ends (`sbsNetwork`)."""
    with Port(subsystem, portname, told=render.print_error) as port:
        render.print_error(f"port {portname} waits for a client")
        port.serve(threading.Event())


class Script:
    """Carries out the commands of a text, one a line.

    Args:
        subsystem: It is open.
        keep_going: Continue after a command that failed.
        as_data: Print JSON, one object a command.
        debug: Show the stack of an error.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        *,
        keep_going: bool = False,
        as_data: bool = False,
        debug: bool = False,
    ) -> None:
        self._subsystem = subsystem
        self._keep_going = keep_going
        self._as_data = as_data
        self._debug = debug
        self._session = CommandSession(
            subsystem, hand_over=lambda port: serve(subsystem, port)
        )

    def run(self, name: str, lines: Iterable[str]) -> bool:
        """Carry the lines out; return whether one failed.

        Args:
            name: Of the file, ``-`` for standard input; for messages.
            lines: The commands.
        """
        place = "standard input" if name == STDIN else name
        listener = Listener(self._subsystem, heard=_print_event)
        listener.open()
        failed = False
        try:
            for number, line in enumerate(lines, 1):
                try:
                    reply = self._session.execute(line)
                except PbonetError as error:
                    failed = True
                    self._report(error, f"{place}:{number}")
                    if not self._keep_going:
                        return failed
                    continue
                if reply is not None:
                    self._show(reply)
                if self._session.ended:
                    return failed
        finally:
            listener.close()
        return failed

    def _show(self, reply: Reply) -> None:
        if self._as_data:
            render.print_line(msgspec.json.encode(reply).decode())
            return
        for warning in reply.warnings:
            render.print_error(render.warning(warning))
        if text := render.text(reply.command, reply.data):
            render.print_line(text)

    def _report(self, error: PbonetError, place: str) -> None:
        if self._as_data:
            fault = {"place": place, "error": error.to_wire()}
            render.print_line(msgspec.json.encode(fault).decode())
        else:
            render.print_error(f"{place}: {render.error(error, debug=self._debug)}")


def _print_event(event: Event) -> None:
    render.print_error(render.event(event))


def _read(name: str) -> Iterable[str]:
    """Return the lines of a script; those of standard input as they come.

    Raises:
        ConfigFileError: The file cannot be read.
    """
    if name == STDIN:
        return sys.stdin
    try:
        return Path(name).read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        got, remedy = error.strerror or str(error), "check the path and its permissions"
    except ValueError as error:
        got, remedy = str(error), "write it as UTF-8 text, one command a line"
    raise ConfigFileError(
        "the script cannot be read", where=name, got=got, remedy=remedy
    )
