"""``pbonet fleet``: all machines and subsystems of a domain."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument


def command(
    *,
    files: A[
        list[Path] | None, Argument("Subsystems whose RTPUs should be there.", "SBS")
    ] = None,
    agents: options.Agents,
    json_: options.Json = False,
) -> int:
    """Show all machines and subsystems of a domain, and what is missing.

    Of a machine: its RTPUs, versions, how long its keys are valid, the disk where runs
    are recorded, its clock. Of a subsystem: its RTPUs, the states of its tasks, its
    flag. The status is 1 if an RTPU is missing.

    Examples:
        Show everything that runs:
        pbonet fleet
        Name the RTPUs of a subsystem that are not there, as data:
        pbonet fleet arm.sbs --json --connect tcp/10.0.0.2:7447
    """
    from pbonet.master.operating import fleet

    found = fleet.ask(agents.domain, agents.connect, files or ())
    options.show(fleet.text(found), found, as_data=json_)
    return int(bool(found.away))
