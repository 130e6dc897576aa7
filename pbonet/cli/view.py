"""``pbonet view``: a subsystem in Foxglove while it runs."""

from __future__ import annotations

from typing import Annotated as A

import typer

from . import options


def command(
    *,
    file: options.File,
    host: A[str, typer.Option(help="Where viewers find it.")] = "127.0.0.1",
    port: A[
        int, typer.Option(help="The same; 0 for one that is free.", min=0, max=65535)
    ] = 8765,
    hz: A[
        float, typer.Option(help="How often values are looked at.", min=0.1, max=200.0)
    ] = 20.0,
    insecure: A[
        bool, typer.Option("--insecure", help="Serve beyond this machine.")
    ] = False,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show the table, states and events in Foxglove as they are now."""
    from pbonet.master.configuration import Place
    from pbonet.master.tools import foxglove_server

    place = Place(
        domain=domain,
        connect=tuple(connect or ()),
        libraries=tuple(map(str, library or ())),
    )
    foxglove_server.view(
        file,
        place,
        foxglove_server.Where(host, port),
        hz=hz,
        insecure=insecure,
        as_data=json_,
    )
