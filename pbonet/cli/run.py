"""``pbonet run``: a whole job, or a sequence of jobs, from one command."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option


def command(
    *,
    file: A[Path, Argument("The .job file, or a .seq file.", "FILE")],
    seconds: A[
        float | None,
        Option("How long it runs, at most; until Ctrl-C if left out.", least=0.0),
    ] = None,
    sim: A[bool, Option("Run in virtual time, without agents and devices.")] = False,
    embed: A[bool, Option("Start an agent for each RTPU that has none.")] = True,
    wait: A[
        float | None,
        Option(
            "Start no agents, and wait up to so many seconds for them.",
            "SECONDS",
            least=0.0,
        ),
    ] = None,
    record: A[
        str | None,
        Option(
            "off, outputs, all or 'last SECONDS'; that of the job if left out.", "WHAT"
        ),
    ] = None,
    runs: A[
        Path | None, Option("Folder of the logs; runs by default.", "FOLDER")
    ] = None,
    profile: A[
        bool, Option("Save the measured execution times of the tasks at the end.")
    ] = False,
    strict: A[
        bool,
        Option(
            "Exit with 3, 4 or 5 if records or cycles were lost, or it was stopped."
        ),
    ] = False,
    place: options.ChangeTransaction,
    json_: options.Json = False,
) -> int:
    """Run a job, or a sequence of jobs, with agents of its own if needed.

    It starts an agent for each RTPU (executor) that has none, verifies the job, creates
    and turns on its tasks, shows their status, and ends them in order. 'pbonet start'
    does only the middle part: it needs running agents and leaves the tasks running.

    A sequence (.seq) runs to its end; Ctrl-C, and --seconds when they are over, lead to
    its safe job first. The status is 1 unless it was done.

    The status is 1 if a task ended in ERROR or something was left. With --strict it is
    3 if not all was recorded, 4 if the machine stood still and cycles were lost, and 5
    if another master stopped its tasks; the last line says which.

    Examples:
        Run a job for 15 seconds and record it:
        pbonet run puma.job --seconds 15
        Try it in virtual time, without the robot:
        pbonet run puma.job --sim --seconds 15
        Run a program of jobs:
        pbonet run carry.seq
    """
    with contextlib.ExitStack() as ending:
        agents = None
        if embed and not sim and wait is None:
            from pbonet.master.console import launch_agents

            launched = launch_agents(file, place, runs=runs)  # the rest is loaded then
            agents = ending.enter_context(launched)
        from pbonet.master.console import run

        outcome = run(
            file,
            place,
            seconds=seconds,
            sim=sim,
            embed=embed,
            wait=wait,
            record=record,
            runs=runs,
            profile=profile,
            quiet=json_,
            strict=strict,
            agents=agents,
        )
    outcome.recording = None
    options.show("", outcome, as_data=json_)
    return outcome.status
