"""``pbonet events``: what happened lately, and what happens from now on."""

from __future__ import annotations

from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Option
from pbonet.cli.table import arguments, show


def command(
    *,
    file: options.File,
    given: A[dict[str, object], arguments("events")],
    follow: A[bool, Option("Then show each new event, until Ctrl-C.")] = False,
    count: A[bool, Option("Show how many of each kind every task reported.")] = False,
    otlp: A[str, Option("Also send each to an OpenTelemetry collector.", "URL")] = "",
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Show the latest events of the tasks and RTPUs (executors).

    Examples:
        Show what went wrong in the last five minutes:
        pbonet events arm.sbs --since 5m --severity warning
        Show the last ten events and each new one:
        pbonet events arm.sbs 10 --follow
        Send every warning to a collector of OpenTelemetry:
        pbonet events arm.sbs --follow --severity warning --otlp http://127.0.0.1:4318
    """
    from pbonet.errors import StateError
    from pbonet.master.console import follow_events, oneshot

    if follow and count:
        raise StateError("--follow and --count exclude each other", remedy="choose one")
    if otlp and not follow:
        raise StateError("--otlp needs --follow", remedy="add it")
    if otlp:
        from pbonet.master.operating import OtelLogs

        with OtelLogs(otlp, lambda text: options.warn([text])) as logs:
            follow_events.follow(file, given, place, as_data=json_, also=logs.add)
    if follow:
        follow_events.follow(file, given, place, as_data=json_)
        return
    if count:
        task = {"task": given["task"]}
        reply = oneshot.run(file, "events count", task, place)
    else:
        reply = oneshot.run(file, "events", given, place)
    show(reply.command, reply.data, reply.warnings, as_data=json_)
