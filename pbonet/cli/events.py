"""``pbonet events``: what happened lately, and what happens from now on."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    file: options.File,
    last: A[int | None, Argument("How many of the newest.", least=0)] = None,
    since: A[
        str | None,
        Option("From this number on, or from so long ago: 30s, 5m, 2h.", "WHEN"),
    ] = None,
    task: A[str | None, Option("Only events of this task.", "TASK")] = None,
    code: A[str | None, Option("Only this kind, such as WARNING.", "CODE")] = None,
    severity: A[
        str | None,
        Option("This and worse: debug, info, warning, error or fatal.", "LEVEL"),
    ] = None,
    follow: A[bool, Option("Then show each new event, until Ctrl-C.")] = False,
    count: A[bool, Option("Show how many of each kind every task reported.")] = False,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Show the latest events of the tasks and RTPUs (executors).

    Examples:
        Show what went wrong in the last five minutes:
        pbonet events arm.sbs --since 5m --severity warning
        Show the last ten events and each new one:
        pbonet events arm.sbs 10 --follow
    """
    from pbonet.errors import StateError
    from pbonet.master.console import follow_events, oneshot

    from .table import show

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
