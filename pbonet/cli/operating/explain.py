"""``pbonet explain``: why something is as it is, and what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option


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
    trace: A[
        float,
        Option(
            "Of a miss: wait at most so long for the next; show what had the core.",
            "SECONDS",
            least=0.0,
            most=30.0,
        ),
    ] = 0.0,
    place: options.Watching,
    json_: options.Json = False,
) -> int:
    """Explain why something is as it is: the causes, and what to do.

    It is about a flag that is up, a task that is OFF, a variable that is stale, an
    RTPU that does not answer, a start that is refused, or cycles that were missed. Of
    what is well it says since when, and its figures. The status is 1 if no cause was
    found and it is not known to be well.

    Examples:
        Explain why the illegal-configuration flag is up:
        pbonet explain arm.sbs
        Explain why a variable is stale:
        pbonet explain arm.sbs Q_REF
        Explain why a job would not start:
        pbonet explain arm.job start
        See who has the core when a task misses its next cycle:
        pbonet explain arm.sbs miss jttrace --trace 5
        Explain which cycles a task has missed in a recorded run:
        pbonet explain runs/2026-05-04T10-00-00-teleop miss jttrace
    """
    from pbonet.master import diagnosis

    found = diagnosis.answer(file, what or (), place, trace=trace)
    options.show(str(found), found, as_data=json_)
    return int(not found.answered)
