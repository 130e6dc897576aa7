"""``pbonet describe``: ports, shapes, units and parameters of a module."""

from __future__ import annotations

from typing import Annotated as A

import typer

from . import options


def command(
    *,
    module: A[str, typer.Argument(help="The module's name, or a .rmod file.")],
    json_: options.Json = False,
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show what a module of this machine's libraries is, or what an RMOD runs."""
    import msgspec

    from pbonet.config import Library
    from pbonet.pbo import render

    found = Library(library or ())
    if module.endswith(".rmod"):
        info = found.load_rmod(found.read_rmod(module)).info
    else:
        info = found.load(module).info
    print(msgspec.json.encode(info).decode() if json_ else render(info).rstrip())
