"""``pbonet stop``: always accepted, needs no master and no file."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    subsystem: A[
        str | None, Argument("Its name or file; every subsystem if left out.")
    ] = None,
    timeout: A[
        float, Option("How long tasks may take to turn off.", "SECONDS", least=0.1)
    ] = 2.0,
    agents: options.Agents,
    json_: options.Json = False,
) -> None:
    """Turn all tasks off and end them, now; this is never refused.

    It needs no master, and without a name no file. A task that does not turn off in
    time is ended by force.

    Examples:
        Stop everything in the domain:
        pbonet stop
        Stop one subsystem:
        pbonet stop arm.sbs
    """
    from pbonet.master.console import stop_all

    from .table import show

    name = stop_all.subsystem_name(subsystem) if subsystem else None
    data = stop_all.stop(
        name, domain=agents.domain, connect=agents.connect, timeout=timeout
    )
    show("stop", data, [], as_data=json_)
