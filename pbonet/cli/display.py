"""``pbonet display``: values of variables, once or again and again."""

from __future__ import annotations

from typing import Annotated as A

import typer

from . import options
from .table import show


def command(
    *,
    file: options.File,
    variable: A[
        list[str] | None, typer.Argument(help="Names; * and ? match; all if left out.")
    ] = None,
    task: A[str | None, typer.Option(help="Those of its ports.")] = None,
    writer: A[str | None, typer.Option(help="Those it writes now.")] = None,
    watch: A[bool, typer.Option("--watch", help="Show them again and again.")] = False,
    csv: A[bool, typer.Option("--csv", help="One line of numbers each time.")] = False,
    every: A[float, typer.Option(help="Seconds between.", min=0.01)] = 0.5,
    count: A[int | None, typer.Option(help="How often; for ever.", min=1)] = None,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show variables of the table with unit, age and writer."""
    from pbonet.master.configuration import Place
    from pbonet.master.console import oneshot, watch_values

    place = Place(
        domain=domain,
        connect=tuple(connect or ()),
        libraries=tuple(map(str, library or ())),
    )
    given = {"variable": variable, "task": task, "writer": writer}
    if not (watch or csv):
        reply = oneshot.run(file, "display", given, place)
        show(reply.command, reply.data, reply.warnings, as_data=json_)
        return
    form = "csv" if csv else "json" if json_ else "text"
    watch_values.display(file, given, place, form=form, every=every, count=count)
