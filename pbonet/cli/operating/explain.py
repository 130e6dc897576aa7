"""``pbonet explain``: why something is as it is, and what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument


def command(
    *,
    file: A[
        Path,
        Argument("The .sbs or .job file, or a recorded run: a log or its folder."),
    ],
    what: A[
        list[str] | None,
        Argument("flag, a task, a variable, an RTPU, start [JOB], miss TASK [CYCLE]."),
    ] = None,
    place: options.Watching,
    json_: options.Json = False,
) -> int:
    """Explain why something is as it is: the causes, and what to do.

    It is about a flag that is up, a task that is OFF, a variable that is stale, an
    RTPU that does not answer, a start that is refused, or cycles that were missed. The
    status is 1 if no cause was found.

    Examples:
        Explain why the illegal-configuration flag is up:
        pbonet explain arm.sbs
        Explain why a variable is stale:
        pbonet explain arm.sbs Q_REF
        Explain why a job would not start:
        pbonet explain arm.job start
        Explain which cycles a task has missed in a recorded run:
        pbonet explain runs/2026-05-04T10-00-00-teleop miss jttrace
    """
    from pbonet.master import diagnosis

    found = diagnosis.answer(file, what or (), place)
    options.show(diagnosis.text(found), found, as_data=json_)
    return int(not found.found)
