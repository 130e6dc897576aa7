"""``pbonet top``: the live table of a subsystem."""

from __future__ import annotations

from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Option


def command(
    *,
    file: options.File,
    sort: A[str, Option("The column by which tasks are sorted.", "COLUMN")] = "",
    wanted: A[
        str, Option("Only rows with this text.", "TEXT", names=("--filter",))
    ] = "",
    every: A[
        float | None,
        Option("Seconds between two readings; 0.5 on a terminal, else 5.", least=0.05),
    ] = None,
    count: A[int | None, Option("Show so many readings at most.", least=1)] = None,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Show tasks, RTPUs and variables live: CPU, misses, ages, flags.

    Tab shows the next table, the arrows select a row, Enter explains it, s sorts by
    the next column, r reverses, / filters, q ends. If the output is no terminal,
    a table is printed for each reading.

    Examples:
        Watch the tasks, those that miss most at the end:
        pbonet top arm.sbs --sort missed
        Print one reading of everything as data:
        pbonet top arm.sbs --json --count 1
    """
    from pbonet.master.operating import live_table

    live_table.watch(
        file,
        place,
        sort=sort,
        wanted=wanted,
        every=every,
        count=count,
        as_data=json_,
    )
