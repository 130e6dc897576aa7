"""``pbonet simulate``: who runs when, and who misses, in virtual time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

import typer

from pbonet.analysis.legality import Times

from . import options


def command(
    *,
    file: A[Path, typer.Argument(help="The .job file.")],
    seconds: A[float, typer.Option(help="How much virtual time passes.")] = 60.0,
    times: A[
        Times, typer.Option(help="MAXC always, or drawn from the measured profile.")
    ] = Times.WORST,
    seed: A[int, typer.Option(help="Of the random times.")] = 0,
    assume: A[
        float | None,
        typer.Option(
            help="Share of its period that a cycle of unknown MAXC takes.",
            min=0.0,
            max=1.0,
        ),
    ] = None,
    code: A[bool, typer.Option("--code", help="Run the modules' code too.")] = False,
    show: A[
        float, typer.Option(help="Seconds of the chart; 0: four longest periods.")
    ] = 0.0,
    svg: A[
        Path | None,
        typer.Option(help="Draw the chart; of several RTPUs one file each."),
    ] = None,
    ascii_: A[
        bool, typer.Option("--ascii", help="Draw the chart in plain characters.")
    ] = False,
    host: options.Host = "",
    json_: options.Json = False,
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Simulate a job's schedule: chart, missed deadlines, response times."""
    import sys

    import msgspec

    from pbonet.analysis.schedule import chart
    from pbonet.master.console import render
    from pbonet.master.tools import schedule_job

    outcome, told = schedule_job.simulate(
        file,
        seconds,
        library or (),
        host=host,
        times=times,
        seed=seed,
        assume=assume,
        code=code,
    )
    show_ns = round(show * 1e9)
    files = schedule_job.write_svg(outcome, svg, show_ns) if svg else []
    if json_:
        data = outcome.as_data() | {"warnings": told, "files": list(map(str, files))}
        print(msgspec.json.encode(data).decode())
        return
    for text in told:
        sys.stderr.write(render.warning(text) + "\n")
    print(outcome.as_text(show_ns=show_ns, marks=chart.ASCII if ascii_ else None))
