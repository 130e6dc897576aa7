"""``pbonet stop``: always accepted, needs no master and no file."""

from __future__ import annotations

from typing import Annotated as A

import typer

from . import options
from .table import show


def command(
    *,
    subsystem: A[
        str | None, typer.Argument(help="Its name or file; all if left out.")
    ] = None,
    timeout: A[
        float, typer.Option(help="Seconds that tasks have for it.", min=0.1)
    ] = 2.0,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Turn everything OFF and end it, now."""
    from pbonet.master.console import oneshot

    name = oneshot.subsystem_name(subsystem) if subsystem else None
    data = oneshot.stop(name, domain=domain, connect=connect or (), timeout=timeout)
    show("stop", data, [], as_data=json_)
