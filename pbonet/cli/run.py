"""``pbonet run``: a whole job from one command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

import typer

from . import options


def command(
    *,
    file: A[Path, typer.Argument(help="The .job file.", metavar="FILE.job")],
    seconds: A[
        float | None, typer.Option(help="How long; until Ctrl-C.", min=0.0)
    ] = None,
    sim: A[
        bool, typer.Option("--sim", help="In virtual time, without devices.")
    ] = False,
    embed: A[
        bool, typer.Option(help="Start agents for RTPUs that nobody runs.")
    ] = True,
    wait: A[
        float | None,
        typer.Option(
            help="Wait so many seconds for RTPUs that nobody runs yet, and start none.",
            min=0.0,
        ),
    ] = None,
    record: A[
        str | None,
        typer.Option(help="off, outputs, all or 'last SECONDS'; as the job says."),
    ] = None,
    runs: A[
        Path | None, typer.Option(help="Folder of the logs; runs by default.")
    ] = None,
    profile: A[
        bool,
        typer.Option("--profile", help="Save the tasks' profiles at the end."),
    ] = False,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    library: options.Library = None,
    take_over: options.TakeOver = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Run a job: assemble it, watch it, end it in order."""
    import msgspec

    from pbonet.master.configuration import Place
    from pbonet.master.console import run

    outcome = run(
        file,
        Place(
            domain=domain,
            connect=tuple(connect or ()),
            libraries=tuple(map(str, library or ())),
            take_over=take_over,
        ),
        seconds=seconds,
        sim=sim,
        embed=embed,
        wait=wait,
        record=record,
        runs=runs,
        profile=profile,
        quiet=json_,
    )
    if json_:
        outcome.recording = None
        print(msgspec.json.encode(outcome).decode())
    raise typer.Exit(outcome.status)
