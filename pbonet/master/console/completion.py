"""Completion at the prompt while a command is typed; from the command table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pbonet.errors import PbonetError
from pbonet.master.subsystem import SIGNALS, status_fields
from pbonet.pbo import MODULE_CLASSES, PREDEFINED, State

from .commands import BY_NAME, Arg, Command, Kind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from .command_session import CommandSession

_STATES: Final = {
    "on": {State.OFF},
    "off": {State.ON},
    "clear": {State.ERROR},
}
"""In which states a task is offered to a signal; the others take every task."""


def complete(session: CommandSession, text: str) -> list[str]:
    """Return the words that may replace the last one in `text`.

    Args:
        session: The interface.
        text: The line up to the cursor.
    """
    words = text.split()
    if not words or text[-1].isspace():
        words.append("")
    *before, last = words
    return sorted(
        word for word in _offers(session, before, last) if word.startswith(last)
    )


def _offers(session: CommandSession, before: list[str], last: str) -> Iterable[str]:
    if not before:
        return {name.split()[0] for name in BY_NAME}
    both = " ".join(before[:2])
    command = BY_NAME.get(both) or BY_NAME.get(before[0])
    if command is None:
        return ()
    given = before[2:] if command.name == both and " " in both else before[1:]
    offers = set(_arguments(session, command, given, last))
    offers |= {
        name.split()[1]
        for name in BY_NAME
        if " " in name and name.split()[0] == before[0] and len(before) == 1
    }
    return offers


def _arguments(
    session: CommandSession, command: Command, given: list[str], last: str
) -> Iterable[str]:
    named = command.named
    name, equals, _ = last.partition("=")
    if equals and name in named:
        return [f"{name}={word}" for word in _words(session, command, named[name], "")]
    names = [word.partition("=")[0] for word in given if "=" in word]
    plain = [
        word for word in given if "=" not in word or word.split("=")[0] not in named
    ]
    places = [a for a in command.args if not a.option and a.name not in names]
    task = session.default
    for word in plain:
        if places and not places[0].many:
            arg = places.pop(0)
            if arg.last and word not in session.subsystem.model and places:
                arg = places.pop(0)  # the task was left out
            task = word if arg.kind is Kind.TASK else task
    found = [f"{arg.word}=" for arg in command.args if arg.option]
    if places and not places[0].need:
        found += [f"{arg.name}=" for arg in places[1:] if arg.name in named]
    for arg in places[:1] if places and not places[0].last else places[:2]:
        found += _words(session, command, arg, task)
    return found


def _words(
    session: CommandSession, command: Command, arg: Arg, task: str
) -> Iterable[str]:
    """Return the words that stand for an argument."""
    if arg.kind is Kind.TASK:
        states = _STATES.get(command.name)
        return [
            member.name
            for member in session.subsystem.model
            if states is None or member.state in states
        ]
    if arg.kind is Kind.PARAM:
        return _params(session, task)
    make = _KINDS.get(arg.kind)
    return make(session) if make else ()


def _params(session: CommandSession, task: str) -> Iterable[str]:
    member = session.subsystem.model.get(task)
    if member is None:
        return ()
    try:
        info = member.info or session.subsystem.task_set.info(member.rtpu, member.rmod)
    except PbonetError:
        return list(member.rmod.local)
    return [param.name for param in info.params]


def _variables(session: CommandSession) -> Iterable[str]:
    return [variable.name for variable in session.subsystem.files.table.variables]


def _signals(session: CommandSession) -> Iterable[str]:
    own = [name for task in session.subsystem.status_all() for name in task.signals]
    return dict.fromkeys([*PREDEFINED, *own])


def _items(session: CommandSession) -> Iterable[str]:
    return [
        f"{t}:{signal}" for t in session.subsystem.model.names for signal in SIGNALS
    ]


def _questions(session: CommandSession) -> Iterable[str]:
    subsystem = session.subsystem
    tasks = (member.name for member in subsystem.model)
    return [
        "flag",
        "start",
        "miss",
        *tasks,
        *_variables(session),
        *subsystem.clients.names,
    ]


_KINDS: Final[dict[Kind, Callable[[CommandSession], Iterable[str]]]] = {
    Kind.RMOD: lambda session: session.subsystem.files.rmods(),
    Kind.RTPU: lambda session: session.subsystem.clients.names,
    Kind.VARIABLE: _variables,
    Kind.CLASS: lambda _: [one.split()[0] for one in MODULE_CLASSES],
    Kind.MODULE: lambda session: session.subsystem.files.library.modules(),
    Kind.JOB: lambda session: session.subsystem.files.jobs(),
    Kind.FIELD: lambda _: [*status_fields.NAMES, "all", "default"],
    Kind.COMMAND: lambda _: BY_NAME,
    Kind.SIGNAL: _signals,
    Kind.ITEM: _items,
    Kind.QUESTION: _questions,
    Kind.FLAG: lambda _: ("yes", "no"),
}
