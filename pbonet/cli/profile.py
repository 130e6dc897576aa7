"""``pbonet profile``: how long cycles take, as figures, as a curve, or saved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

import typer

from . import options


def command(
    *,
    file: options.File,
    task: A[
        list[str] | None, typer.Argument(help="Which; all if left out.", metavar="TASK")
    ] = None,
    plot: A[
        Path | None,
        typer.Option(help="Draw the execution profiles: .png, .svg or .pdf."),
    ] = None,
    save: A[
        bool, typer.Option("--save", help="Save the profiles beside the .sbs file.")
    ] = False,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show how long cycles take: every figure, and the execution profile."""
    from pbonet.master.configuration import Place
    from pbonet.master.console import oneshot, profile_plot

    from .table import show

    place = Place(
        domain=domain,
        connect=tuple(connect or ()),
        libraries=tuple(map(str, library or ())),
    )
    name = "profile save" if save else "profile"
    reply = oneshot.run(file, name, {"task": task or []}, place)
    if plot is not None:
        shown = reply
        if save:
            shown = oneshot.run(file, "profile", {"task": task or []}, place)
        profile_plot.draw(plot, shown.data["tasks"])
    show(reply.command, reply.data, reply.warnings, as_data=json_)
