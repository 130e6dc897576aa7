"""Make a verb of a command of the table: its arguments, help and examples are its."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated as A, Any, Final

from pbonet.master.console import Arg, Command, Kind, find

from . import options
from .parser import Compound, Option, Parameter, Verb, parameter

if TYPE_CHECKING:
    from pbonet.master.configuration import Place

_FILE = "arm.sbs"
"""The subsystem of examples."""
_TYPES = {Kind.FLAG: bool, Kind.NUMBER: float, Kind.COUNT: int}
"""Types of words that the command line checks; the others are the command's matter."""


_EVERY = "Repeat with so many seconds between; 0.5 on a terminal, else 5."
_REPEAT = Compound(
    (
        parameter(
            "watch",
            A[bool, Option("Repeat until Ctrl-C, over the last table.")],
            default=False,
        ),
        parameter("every", A[float | None, Option(_EVERY, least=0.05)]),
        parameter(
            "count", A[int | None, Option("Repeat so many times at most.", least=1)]
        ),
    ),
    dict,
)
_WATCHED: Final = {"status": ("--watch", "Watch all tasks until Ctrl-C.")}
"""Commands that a verb may repeat; the words of an example, and its use."""


def verb(name: str) -> Verb:
    """Return the verb for a command."""
    command = find(name)

    def run(
        *,
        file: Path,
        place: Place,
        json_: bool,
        repeat: dict[str, Any] | None = None,
        **given: object,
    ) -> None:
        from pbonet.errors import StateError
        from pbonet.master.console import oneshot

        if repeat and any(repeat.values()):
            _watch(file, given, place, repeat, as_data=json_)
            return
        try:
            reply = oneshot.run(file, command.name, given, place)
        except StateError as error:
            if error.expected == command.usage:  # that of the prompt
                error.expected = made.usage
                error.remedy = f"'pbonet {name} --help' explains it"
            raise
        show(reply.command, reply.data, reply.warnings, as_data=json_)

    place = options.TO_CHANGE if command.changes else options.TO_WATCH
    parameters = [
        Parameter(
            "file",
            "The subsystem's .sbs file, or a .job file that names it.",
            "FILE",
            kind=Path,
            need=True,
        ),
        *arguments(name).parts,
        *(_REPEAT.parts if name in _WATCHED else ()),
        *place.parts,
        parameter("json_", options.Json, default=False),
    ]
    examples = tuple((example(command, line), use) for line, use in command.examples)
    compounds = {"place": place}
    if name in _WATCHED:
        words, use = _WATCHED[name]
        examples += ((f"pbonet {name} {_FILE} {words}", use),)
        compounds["repeat"] = _REPEAT
    made = Verb(name, command.help, examples, tuple(parameters), run, compounds)
    return made


def _watch(
    file: Path,
    given: dict[str, object],
    place: Place,
    repeat: dict[str, Any],
    *,
    as_data: bool,
) -> None:
    """Show the status again and again.

    Raises:
        StateError: The extremes are to be restarted, too.
    """
    from pbonet.errors import StateError
    from pbonet.master.console import watch_status

    if given.get("reset"):
        raise StateError(
            "--reset and --watch exclude each other", remedy="reset first, then watch"
        )
    every, count = repeat["every"], repeat["count"]
    watch_status.watch(file, given, place, every=every, count=count, as_data=as_data)


def arguments(name: str) -> Compound:
    """Return a command's arguments, for a verb that takes more than these."""
    return Compound(tuple(map(_parameter, find(name).args)), dict)


def example(command: Command, line: str) -> str:
    """Return the verb's command line for a line of the prompt."""
    name, *words = shlex.split(line)
    found = ["pbonet", name, _FILE]
    for word in words:
        key, equals, value = word.partition("=")
        arg = command.named.get(key) if equals else None
        if arg is None:
            found.append(word)
        elif not arg.option:
            found.append(value)
        else:
            found.append(_option(arg))
            found += [value] * (arg.kind is not Kind.FLAG)
    return shlex.join(found)


def show(
    command: str, data: dict[str, Any], warnings: list[str], *, as_data: bool
) -> None:
    """Print what a command gave: data as JSON, or text with warnings beside it."""
    from pbonet.master.console import render

    text = "" if as_data else render.text(command, data)
    options.show_warned(text, data, warnings, as_data=as_data)


def _parameter(arg: Arg) -> Parameter:
    """Return one argument of the table; the command converts its words."""
    kind = arg.word if arg.kind is Kind.WORD else arg.kind
    return Parameter(
        arg.name,
        f"{arg.doc[:1].upper()}{arg.doc[1:]}.",
        kind.upper() if arg.option else arg.name.upper(),
        (_option(arg),) if arg.option else (),
        kind=_TYPES.get(arg.kind, str),
        many=arg.many,
        need=arg.need or arg.last,
        default=False if arg.kind is Kind.FLAG else None,
        least=0 if arg.kind is Kind.COUNT else None,
        stands_for=arg.kind,
    )


def _option(arg: Arg) -> str:
    return f"--{arg.word.replace('_', '-')}"
