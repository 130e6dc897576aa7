"""``pbonet sbs``: the prompt, a script, the network interface, or all of them."""

from __future__ import annotations

import sys
from typing import Annotated as A

import typer

from . import options


def command(
    *,
    file: options.File,
    script: A[
        list[str] | None,
        typer.Option(help="Commands, one a line; - is standard input."),
    ] = None,
    network: A[
        str | None, typer.Option(help="Serve this port next.", metavar="PORTNAME")
    ] = None,
    prompt: A[
        bool | None,
        typer.Option(help="The prompt last; by default if nothing else is asked for."),
    ] = None,
    leave: A[
        bool, typer.Option("--leave", help="Leave the tasks as they are in the end.")
    ] = False,
    keep_going: A[
        bool, typer.Option("--keep-going", help="Go on after a command that failed.")
    ] = False,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    library: options.Library = None,
    take_over: options.TakeOver = False,
    debug: options.Debug = False,
) -> None:
    """Be the master of a subsystem: prompt, script, network."""
    from pbonet.master.configuration import Place
    from pbonet.master.console import interfaces

    scripts = script or ([] if sys.stdin.isatty() or network else [interfaces.STDIN])
    place = Place(
        domain=domain,
        connect=tuple(connect or ()),
        libraries=tuple(map(str, library or ())),
        take_over=take_over,
    )
    raise typer.Exit(
        interfaces.run(
            file,
            place,
            scripts=scripts,
            network=network,
            prompt=not (scripts or network) if prompt is None else prompt,
            leave=leave,
            keep_going=keep_going,
            as_data=json_,
            debug=debug,
        )
    )
