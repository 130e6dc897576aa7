"""``pbonet adopt``: measured execution times become MINC and MAXC."""

from __future__ import annotations

from typing import Annotated as A

import typer

from . import options


def command(
    *,
    file: options.File,
    rmod: A[
        list[str] | None,
        typer.Argument(help="Which; all that were measured if left out."),
    ] = None,
    margin: A[
        float,
        typer.Option(help="Per cent between what was measured and MAXC.", min=0.0),
    ] = 20.0,
    dry_run: A[
        bool, typer.Option("--dry-run", help="Show the changes and write nothing.")
    ] = False,
    host: options.Host = "",
    json_: options.Json = False,
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Write saved profiles into RMODs, as MINC, MAXC and EFFC of soft tasks."""
    import sys

    import msgspec

    from pbonet.master.configuration import adopt
    from pbonet.master.console import render

    found, warnings = adopt(
        file, rmod or (), library or (), margin=margin, host=host, dry_run=dry_run
    )
    if json_:
        data = {"adopted": msgspec.to_builtins(found), "warnings": warnings}
        print(msgspec.json.encode(data).decode())
        return
    for text in warnings:
        sys.stderr.write(render.warning(text) + "\n")
    print("\n".join(render.adopted(one, dry_run=dry_run) for one in found))
