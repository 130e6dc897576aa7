"""``pbonet adopt``: measured execution times become MINC and MAXC."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    file: options.File,
    rmod: A[
        list[str] | None, Argument("Which .rmod files; all with a profile if left out.")
    ] = None,
    margin: A[
        float, Option("Per cent by which MAXC is above what was measured.", least=0.0)
    ] = 20.0,
    dry_run: A[bool, Option("Show the changes and write nothing.")] = False,
    host: options.Host = "",
    library: options.Library = None,
    json_: options.Json = False,
) -> None:
    """Write measured execution times into .rmod files, as MINC and MAXC.

    MAXC is the worst-case execution time that the schedulability analysis uses, MINC
    the best case, EFFC what a cycle of a soft task is counted with. 'pbonet profile
    --save' and 'pbonet run --profile' save the measurements.

    Examples:
        Show what would change in one file:
        pbonet adopt arm.sbs grav_comp --dry-run
        Write all that was measured, with half as much again as a margin:
        pbonet adopt arm.sbs --margin 50
    """
    import msgspec

    from pbonet.master.configuration import adopt
    from pbonet.master.console import render

    found, warnings = adopt(
        file, rmod or (), library or (), margin=margin, host=host, dry_run=dry_run
    )
    options.show_warned(
        "\n".join(render.adopted(one, dry_run=dry_run) for one in found),
        {"adopted": msgspec.to_builtins(found)},
        warnings,
        as_data=json_,
    )
