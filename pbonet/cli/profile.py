"""``pbonet profile``: how long cycles take, as figures, as a curve, or saved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Option
from .table import arguments, show


def command(
    *,
    file: options.File,
    given: A[dict[str, object], arguments("profile")],
    plot: A[
        Path | None, Option("Draw the execution profiles into a .png, .svg or .pdf.")
    ] = None,
    save: A[bool, Option("Save the profiles beside the .sbs file.")] = False,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Show how long the cycles of tasks take, since they were turned on.

    Saved profiles count in 'pbonet check' and at every start. 'pbonet adopt' writes
    them into .rmod files, as MAXC (worst-case execution time).

    Examples:
        Show the figures of one task and draw their distribution:
        pbonet profile arm.sbs grav_comp --plot profile.svg
        Keep what was measured for the analysis of later starts:
        pbonet profile arm.sbs --save
    """
    from pbonet.master.console import oneshot

    name = "profile save" if save else "profile"
    reply = oneshot.run(file, name, given, place)
    if plot is not None:
        from pbonet.master.console import profile_plot

        shown = reply
        if save:
            shown = oneshot.run(file, "profile", given, place)
        profile_plot.draw(plot, shown.data["tasks"])
    show(reply.command, reply.data, reply.warnings, as_data=json_)
