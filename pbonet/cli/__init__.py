"""The command line: one verb a file, no logic.

Errors of pbonet end a verb with status 1 and a message of four parts, wrong usage with
status 2, an interrupt with status 130. ``--json`` gives data, also of an error;
``--debug`` adds the stack to a message.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from importlib import import_module
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperGroup

from pbonet.errors import PbonetError

from . import options

if TYPE_CHECKING:
    from collections.abc import Sequence

VERBS = (
    *("run", "sbs", "check", "describe", "new", "agent", "doctor", "keys"),
    *("start", "stop", "spawn", "on", "off", "kill", "clear", "reinit", "reconfig"),
    *("swap", "switch"),
    *("status", "profile", "adopt", "simulate"),
    *("display", "write", "get", "set", "freq", "module"),
    *("events", "sigwait", "sigmask"),
    *("log", "replay", "view"),
)
"""The verbs in the order of the help; each stands in a file of its name."""


class Verbs(TyperGroup):
    """The verbs; wrong usage of one is told with the word that is wrong."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - as Typer has it
        """Carry out the verb that was given."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            cause: Any = error.__cause__
            if hasattr(cause, "errors"):  # older releases of Typer name the word
                told = error.message.partition(", unable to parse")[0]
                error.message = f"{told} (got {cause.errors()[0]['input']!r})"
            raise


def build() -> typer.Typer:
    """Return the application with all verbs."""
    app = typer.Typer(
        name="pbonet",
        cls=Verbs,
        help="Assemble a robot's control software from ready modules, and change it "
        "while it runs.",
        no_args_is_help=True,
        add_completion=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(options.version)
    for verb in VERBS:
        command = import_module(f"pbonet.cli.{verb}").command
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=verb)
        else:
            settings = getattr(command, "context_settings", {})
            app.command(verb, context_settings=settings)(command)
    return app


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    options.chosen.json = options.chosen.debug = False
    _have_streams()
    try:
        build()(args=argv, standalone_mode=True)
    except PbonetError as error:
        _tell(error)
        sys.exit(1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _have_streams() -> None:
    """Have output go nowhere where it was closed, for which Python has None."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def _tell(error: PbonetError) -> None:
    """Show an error: as data with ``--json``, with its stack with ``--debug``.

    Warnings that came before it are its notes.
    """
    warnings: list[str] = getattr(error, "__notes__", [])
    if options.chosen.json:
        print(json.dumps({"error": error.to_wire(), "warnings": warnings}))
    else:
        for warning in warnings:
            sys.stderr.write(f"WARNING> {warning}\n")
        sys.stderr.write(f"pbonet: {error}\n")
    if options.chosen.debug:
        sys.stderr.write(f"{error.debug.rstrip()}\n" if error.debug else "")
        sys.stderr.write("".join(traceback.format_exception(error)))
