"""``pbonet display``: values of variables, once or repeatedly."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    file: options.File,
    variable: A[
        list[str] | None,
        Argument("Names; * and ? match any text; all if left out."),
    ] = None,
    task: A[str | None, Option("Only variables of this task's ports.", "TASK")] = None,
    writer: A[str | None, Option("Only those this task writes now.", "TASK")] = None,
    watch: A[bool, Option("Repeat until Ctrl-C, over the last values.")] = False,
    csv: A[bool, Option("Repeat until Ctrl-C, one row of numbers each time.")] = False,
    every: A[float, Option("Seconds between two times.", least=0.01)] = 0.5,
    count: A[int | None, Option("How many times, at most.", least=1)] = None,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Show the values of shared variables, with unit, age and writer.

    'pbonet status' shows tasks and their timing; 'pbonet view' shows both as plots, in
    Foxglove.

    Examples:
        Show every joint variable, and again twice a second:
        pbonet display arm.sbs 'Q_*' --watch
        Record 100 rows for a spreadsheet:
        pbonet display arm.sbs Q_MEZ --csv --every 0.1 --count 100
    """
    from pbonet.master.console import oneshot, watch_values

    from .table import show

    given = {"variable": variable, "task": task, "writer": writer}
    if not (watch or csv):
        reply = oneshot.run(file, "display", given, place)
        show(reply.command, reply.data, reply.warnings, as_data=json_)
        return
    form = "csv" if csv else "json" if json_ else "text"
    watch_values.display(file, given, place, form=form, every=every, count=count)
