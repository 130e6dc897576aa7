"""``pbonet new``: write the first files of a module, of a table, of a job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

import typer

from . import options

command = typer.Typer(
    help="Write the beginning of something new.", no_args_is_help=True
)


Name = A[str, typer.Argument(help="Its name: letters, digits, underscores.")]
Rmods = A[
    list[str],
    typer.Argument(
        help="The tasks: RMODs of this folder or a library.", metavar="RMOD..."
    ),
]
Sizes = A[
    list[str] | None,
    typer.Option("--size", help="A size that no port says.", metavar="NAME=NUMBER"),
]
Folder = A[Path, typer.Option(help="Where it is written.")]
Force = A[bool, typer.Option("--force", help="Write over files.")]


@command.callback()
def new() -> None:
    """Write the beginning of something new."""


@command.command("module")
def module(
    *,
    name: Name,
    inputs: A[
        list[str] | None,
        typer.Option("--in", help="An in-var, NAME[:SHAPE[:UNIT[:TYPE]]]."),
    ] = None,
    outputs: A[list[str] | None, typer.Option("--out", help="An out-var.")] = None,
    inconst: A[list[str] | None, typer.Option(help="An in-const.")] = None,
    outconst: A[list[str] | None, typer.Option(help="An out-const.")] = None,
    svar: A[
        Path | None, typer.Option(help="A .svar file that knows shapes and units.")
    ] = None,
    desc: A[str, typer.Option(help="What it does, in one line.")] = "",
    freq: A[float, typer.Option(help="Its frequency, Hz.", min=1e-3)] = 100.0,
    timing_failure: A[
        bool,
        typer.Option("--timing-failure", help="With a handler of timing failures."),
    ] = False,
    folder: Folder = Path(),
    force: Force = False,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Write a module, its RMOD and its test from a list of ports."""
    from pbonet.master.tools import write_new_files

    ports = {
        "in": inputs or [],
        "out": outputs or [],
        "inconst": inconst or [],
        "outconst": outconst or [],
    }
    paths = write_new_files.new_module(
        name,
        ports,
        svar=svar,
        desc=desc,
        freq=freq,
        timing_failure=timing_failure,
        folder=folder,
        force=force,
    )
    options.show_files(paths, as_data=json_)


@command.command("svar")
def svar(
    *,
    name: Name,
    rmods: Rmods,
    sizes: Sizes = None,
    library: options.Library = None,
    folder: Folder = Path(),
    force: Force = False,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Write the table that tasks need: every variable, as their modules say it is."""
    from pbonet.master.tools import write_new_files

    paths, told = write_new_files.new_svar(
        name,
        rmods,
        sizes=sizes or (),
        libraries=library or (),
        folder=folder,
        force=force,
    )
    options.show_files(paths, told, as_data=json_)


@command.command("job")
def job(
    *,
    name: Name,
    rmods: Rmods,
    sbs: A[
        Path | None, typer.Option(help="The subsystem; it and its table are new else.")
    ] = None,
    sizes: Sizes = None,
    desc: A[str, typer.Option(help="What it does, in one line.")] = "",
    library: options.Library = None,
    folder: Folder = Path(),
    force: Force = False,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Write a job of tasks, and the subsystem with its table if there is none."""
    from pbonet.master.tools import write_new_files

    paths, told = write_new_files.new_job(
        name,
        rmods,
        sbs=sbs,
        sizes=sizes or (),
        desc=desc,
        libraries=library or (),
        folder=folder,
        force=force,
    )
    options.show_files(paths, told, as_data=json_)
