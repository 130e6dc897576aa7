"""``pbonet display``: values of variables, once or repeatedly."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Option
from .table import arguments, show


def command(
    *,
    file: options.File,
    given: A[dict[str, object], arguments("display")],
    watch: A[bool, Option("Repeat until Ctrl-C, over the last values.")] = False,
    csv: A[bool, Option("Repeat until Ctrl-C, one row of numbers each time.")] = False,
    every: A[
        float | None,
        Option("Repeat with so many seconds between; 0.5 if left out.", least=0.01),
    ] = None,
    count: A[int | None, Option("Repeat so many times at most.", least=1)] = None,
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

    if not (watch or csv or every or count):
        reply = oneshot.run(file, "display", given, place)
        show(reply.command, reply.data, reply.warnings, as_data=json_)
        return
    form = "csv" if csv else "json" if json_ else "text"
    watch_values.display(file, given, place, form=form, every=every or 0.5, count=count)
