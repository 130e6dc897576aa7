"""Makes a verb of a command of the table: its arguments and options are the table's."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated as A, Any

import typer

from pbonet.master.console import Arg, Command, Kind, Use, find

from . import options


def verb(name: str) -> Callable[..., None]:
    """Return the function of the verb for a command; typer reads its signature."""
    command = find(name)

    def run(file: Path, **given: Any) -> None:  # noqa: ANN401 - what the table says
        from pbonet.master.configuration import Place
        from pbonet.master.console import oneshot

        place = Place(
            domain=given.pop("domain"),
            connect=tuple(given.pop("connect") or ()),
            libraries=tuple(map(str, given.pop("library") or ())),
            take_over=given.pop("take_over", False),
        )
        as_data = given.pop("json_")
        for acted in ("keys", "debug"):  # when they were read
            given.pop(acted)
        reply = oneshot.run(file, command.name, given, place)
        show(reply.command, reply.data, reply.warnings, as_data=as_data)

    run.__name__ = name
    run.__doc__ = command.help
    vars(run)["__signature__"] = inspect.Signature(list(_parameters(command)))
    values = [arg for arg in command.args if arg.kind in {Kind.NUMBER, Kind.WORD}]
    vars(run)["context_settings"] = {  # so that -1.5 is a value and no option
        "ignore_unknown_options": any(arg.many for arg in values)
    }
    return run


def show(
    command: str, data: dict[str, Any], warnings: list[str], *, as_data: bool
) -> None:
    """Print what a command gave: data as JSON, or text with warnings beside it."""
    import msgspec

    from pbonet.master.console import render

    if as_data:
        print(msgspec.json.encode({**data, "warnings": warnings}).decode())
        return
    for warning in warnings:
        sys.stderr.write(render.warning(warning) + "\n")
    if text := render.text(command, data):
        print(text)


def _parameters(command: Command) -> list[inspect.Parameter]:
    where = inspect.Parameter.KEYWORD_ONLY
    found = [inspect.Parameter("file", where, annotation=options.File)]
    found += [_parameter(arg) for arg in command.args]
    common: dict[str, tuple[Any, object]] = {
        "json_": (options.Json, False),
        "domain": (options.Domain, "default"),
        "connect": (options.Connect, None),
        "keys": (options.Keys, None),
        "library": (options.Library, None),
        "debug": (options.Debug, False),
    }
    if command.changes:
        common["take_over"] = (options.TakeOver, False)
    found += [
        inspect.Parameter(name, where, annotation=kind, default=default)
        for name, (kind, default) in common.items()
    ]
    return found


def _parameter(arg: Arg) -> inspect.Parameter:
    """Return one argument of the table as typer wants it: a word for `convert`."""
    kind: Any = str
    where = inspect.Parameter.KEYWORD_ONLY
    if arg.kind is Kind.FLAG:
        flag = typer.Option(f"--{arg.name.replace('_', '-')}", help=arg.doc)
        return inspect.Parameter(
            arg.name, where, annotation=A[bool, flag], default=False
        )
    if arg.use is Use.NAMED:
        about: Any = typer.Option(f"--{arg.name}", help=arg.doc, metavar=arg.kind)
    else:
        about = typer.Argument(help=arg.doc, metavar=arg.name.upper())
    if arg.many:
        kind = list[kind]
    if arg.need or arg.last:
        return inspect.Parameter(arg.name, where, annotation=A[kind, about])
    return inspect.Parameter(
        arg.name, where, annotation=A[kind | None, about], default=None
    )
