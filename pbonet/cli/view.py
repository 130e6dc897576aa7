"""``pbonet view``: a subsystem in Foxglove while it runs."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Option


def command(
    *,
    file: options.File,
    host: A[str, Option("The address it serves.", "ADDRESS")] = "127.0.0.1",
    port: A[
        int, Option("The port it serves; 0 takes a free one.", least=0, most=65535)
    ] = 8765,
    hz: A[
        float, Option("How many times a second values are read.", least=0.1, most=200.0)
    ] = 20.0,
    insecure: A[bool, Option("Serve other machines too, unprotected.")] = False,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Serve variables, states and events to Foxglove, which plots them.

    'pbonet display' and 'pbonet status' show them in the terminal.

    Examples:
        Serve a running subsystem, and open ws://127.0.0.1:8765 in Foxglove:
        pbonet view arm.sbs
        Read the values 100 times a second, and serve another port:
        pbonet view arm.sbs --hz 100 --port 9000
    """
    from pbonet.master.tools import foxglove_server

    foxglove_server.view(
        file,
        place,
        foxglove_server.Where(host, port),
        hz=hz,
        insecure=insecure,
        as_data=json_,
    )
