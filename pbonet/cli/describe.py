"""``pbonet describe``: ports, shapes, units and parameters of a module."""

from __future__ import annotations

from typing import Annotated as A

import typer

from pbonet.cli import options


def command(
    *,
    module: A[str, typer.Argument(help="The module's name.")],
    json_: options.Json = False,
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show what a module of this machine's libraries is."""
    import msgspec

    from pbonet.config.library import Library
    from pbonet.pbo import render

    info = Library(library or ()).load(module).info
    print(msgspec.json.encode(info).decode() if json_ else render(info).rstrip())
