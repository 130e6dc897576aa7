"""``pbonet web``: a subsystem in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    file: A[
        Path,
        Argument(
            "The .job, .sbs or .seq file, or a recorded run: a log or its folder."
        ),
    ],
    host: A[str, Option("The address it serves.", "ADDRESS")] = "127.0.0.1",
    port: A[
        int, Option("The port it serves; 0 takes a free one.", least=0, most=65535)
    ] = 8080,
    name: A[
        list[str] | None, Option("Another host name that browsers use for it.", "NAME")
    ] = None,
    tls: A[
        Path | None,
        Option("A folder with cert.pem and key.pem, to serve other machines."),
    ] = None,
    observe: A[bool, Option("Only show; nobody can steer by this page.")] = False,
    hz: A[
        float, Option("How many times a second values are read.", least=0.1, most=100.0)
    ] = 20.0,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Serve a page that shows a subsystem, plots it and steers it.

    It prints a link for operators and one for observers.

    Examples:
        Serve a job, started or not, and open the link that is printed:
        pbonet web arm.job
        Show a recorded run:
        pbonet web runs/2026-05-04T10-00-00-teleop
        Serve a tablet at the machine, with keys for TLS:
        pbonet web arm.job --host 10.0.0.2 --tls web-keys
    """
    from pbonet.master import web

    served = web.Served(
        host=host,
        port=port,
        names=tuple(name or ()),
        tls=tls,
        observe=observe,
        hz=hz,
    )
    web.serve(file, place, served, as_data=json_)
