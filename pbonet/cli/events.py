"""``pbonet events``: what happened lately, and what happens from now on."""

from __future__ import annotations

from typing import Annotated as A

import typer

from . import options


def command(
    *,
    file: options.File,
    last: A[int | None, typer.Argument(help="How many.", metavar="LAST", min=0)] = None,
    since: A[
        str | None, typer.Option(help="Number of the first, or how long ago: 5m.")
    ] = None,
    task: A[str | None, typer.Option(help="Of one task.")] = None,
    code: A[str | None, typer.Option(help="Of one code, such as WARNING.")] = None,
    severity: A[
        str | None,
        typer.Option(help="The least: debug, info, warning, error or fatal."),
    ] = None,
    follow: A[bool, typer.Option("--follow", help="Go on with each new one.")] = False,
    count: A[
        bool, typer.Option("--count", help="How often each kind came, by task.")
    ] = False,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show what happened lately."""
    from pbonet.errors import StateError
    from pbonet.master.configuration import Place
    from pbonet.master.console import follow_events, oneshot

    from .table import show

    place = Place(
        domain=domain,
        connect=tuple(connect or ()),
        libraries=tuple(map(str, library or ())),
    )
    given: dict[str, object] = {"last": last, "since": since, "task": task}
    given |= {"code": code, "severity": severity}
    if follow and count:
        raise StateError("--follow and --count do not go together", remedy="choose one")
    if follow:
        follow_events.follow(file, given, place, as_data=json_)
        return
    if count:
        tasks: dict[str, object] = {"task": [task] if task else []}
        reply = oneshot.run(file, "events count", tasks, place)
    else:
        reply = oneshot.run(file, "events", given, place)
    show(reply.command, reply.data, reply.warnings, as_data=json_)
