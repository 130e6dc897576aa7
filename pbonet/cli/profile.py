"""``pbonet profile``: how long cycles take, as figures, as a curve, or saved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    file: options.File,
    task: A[list[str] | None, Argument("Which tasks; all if left out.")] = None,
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

    from .table import show

    name = "profile save" if save else "profile"
    reply = oneshot.run(file, name, {"task": task or []}, place)
    if plot is not None:
        from pbonet.master.console import profile_plot

        shown = reply
        if save:
            shown = oneshot.run(file, "profile", {"task": task or []}, place)
        profile_plot.draw(plot, shown.data["tasks"])
    show(reply.command, reply.data, reply.warnings, as_data=json_)
