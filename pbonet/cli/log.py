"""``pbonet log``: what was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated as A

import typer

from . import options

command = typer.Typer(help="Look at what was recorded.", no_args_is_help=True)

File = A[
    Path | None,
    typer.Argument(help="A log, or a run's folder; the newest in runs by default."),
]
Out = A[Path, typer.Option("--out", "-o", help="The new file.")]


def _written(
    out: Path, json_: bool, messages: int | None = None, clocks: Sequence[str] = ()
) -> None:
    import msgspec

    if json_:
        data = {"file": str(out), "messages": messages, "clocks": clocks}
        print(msgspec.json.encode(data).decode())
    else:
        print(out if messages is None else f"{out}: {messages} messages")
        print("\n".join(clocks), end="\n" * bool(clocks))


@command.callback()
def log() -> None:
    """Look at what was recorded."""


@command.command("info")
def info(
    *,
    file: File = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Say what a log holds: duration, tasks, rates, misses, events."""
    import msgspec

    from pbonet.log import Log, last_run, text

    data = text.info(Log(file or last_run()))
    print(msgspec.json.encode(data).decode() if json_ else text.info_text(data))


@command.command("cat")
def cat(
    *,
    file: A[Path, typer.Argument(help="A log, or a run's folder.")],
    task: A[str, typer.Argument(help="The task.")],
    variables: A[
        list[str] | None, typer.Argument(help="Which; all that it writes.")
    ] = None,
    out: A[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Write a file, as its name ends: .csv, .json, .npz or .parquet.",
        ),
    ] = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Give a task's values, one row a cycle, as CSV, JSON, Parquet or for numpy."""
    import sys

    from pbonet.log import Log, export, text

    form = export.form_of(out) if out is not None else None
    log = Log(file)
    table = text.columns(log, task, variables or ())
    if out is not None and form is not None:
        export.write_file(table, out, form, log, task)
        _written(out, json_)
        return
    write = export.write_json if json_ else export.write_csv
    write(table, sys.stdout)


@command.command("events")
def events(
    *,
    file: File = None,
    task: A[str | None, typer.Option(help="Of one task.")] = None,
    code: A[str | None, typer.Option(help="Of one code, such as WARNING.")] = None,
    severity: A[
        str | None,
        typer.Option(help="The least: debug, info, warning, error or fatal."),
    ] = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show the events of a run."""
    import msgspec

    from pbonet.log import Log, last_run
    from pbonet.master.console import render
    from pbonet.master.subsystem import Choice
    from pbonet.xm.net import Event

    wanted = Choice.of({"task": task, "code": code, "severity": severity})
    found = [msgspec.convert(one, Event) for one in Log(file or last_run()).events()]
    chosen = [event for event in found if wanted(event)]
    if doubt := wanted.doubt(found):
        render.print_error(render.warning(doubt))
    if json_:
        print(msgspec.json.encode({"events": chosen}).decode())
        return
    for event in chosen:
        print(render.event(event))


@command.command("commands")
def commands(
    *,
    file: File = None,
    task: A[
        str | None, typer.Option(help="Those that name this task, or stop all.")
    ] = None,
    op: A[str | None, typer.Option(help="Of one kind, such as control.")] = None,
    refused: A[
        bool, typer.Option("--refused", help="Only those that were not carried out.")
    ] = False,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show the commands that a run was given, by whom, and what came of them."""
    import sys

    import msgspec

    from pbonet.log import Log, last_run, orders

    log = Log(file or last_run())
    found = log.commands()
    chosen = orders.chosen(found, task=task, op=op, refused=refused)
    if json_:
        print(msgspec.json.encode({"commands": chosen}).decode())
        return
    if not chosen:
        sys.stderr.write(f"{orders.none_of(log.about, found)}\n")
    for one in chosen:
        print(orders.line(one))


@command.command("plot")
def plot(
    *,
    file: A[Path, typer.Argument(help="A log, or a run's folder.")],
    variables: A[list[str], typer.Argument(help="Which, one picture for each.")],
    out: Out = Path("log.png"),
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Draw variables over time."""
    from pbonet.log import Log
    from pbonet.master.tools import log_plot

    log_plot.draw(Log(file), variables, out)
    _written(out, json_)


@command.command("diff")
def diff(
    *,
    one: A[Path, typer.Argument(help="A log, or a run's folder.")],
    other: A[Path, typer.Argument(help="Another.")],
    task: A[list[str] | None, typer.Option(help="Only this one.")] = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Compare two runs: the first cycle in which each variable differs."""
    import msgspec

    from pbonet.log import Log, text

    rows = text.diff(Log(one), Log(other), task or ())
    print(msgspec.json.encode(rows).decode() if json_ else text.diff_text(rows))
    raise typer.Exit(int(any(row["first"] is not None for row in rows)))


@command.command("merge")
def merge(
    *,
    files: A[list[Path], typer.Argument(help="Logs, or folders of runs.")],
    out: Out,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Make one log of several, ordered by time."""
    from pbonet.log import merge as do

    done = do(files, out)
    _written(
        out, json_, done.messages, [str(one) for one in done.clocks if one.matters]
    )


@command.command("recover")
def recover(
    *,
    file: A[Path, typer.Argument(help="A log that was cut short.")],
    out: Out,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Make a whole log of one that was cut short."""
    from pbonet.log import recover as do

    _written(out, json_, do(file, out))
