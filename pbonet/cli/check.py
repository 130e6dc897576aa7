"""``pbonet check``: is this file right?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

import typer

from . import options


def command(
    *,
    file: A[list[Path], typer.Argument(help=".svar .rmod .sbs .job or .toml files.")],
    host: options.Host = "",
    json_: options.Json = False,
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Judge files of any kind; no agent is needed. Status 1 when one is wrong.

    Of a job it also says which deadlines are kept, and what that rests on.
    """
    import msgspec

    from pbonet.master.configuration import check_file

    found = [check_file(path, library or (), host) for path in file]
    if json_:
        data = [{**msgspec.to_builtins(one), "legal": one.legal} for one in found]
        print(msgspec.json.encode(data).decode())
    else:
        print("\n".join(line for one in found for line in one.lines()))
    raise typer.Exit(0 if all(one.legal for one in found) else 1)
