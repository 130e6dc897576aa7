"""``pbonet simulate``: who runs when, and who misses, in virtual time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A, Literal

from . import options
from .parser import Argument, Option


def command(
    *,
    file: A[Path, Argument("The .job file.")],
    seconds: A[float, Option("How much virtual time passes.", "SECONDS")] = 60.0,
    times: A[
        Literal["worst", "random"],
        Option("Each cycle takes MAXC (worst case), or a random time as measured."),
    ] = "worst",
    seed: A[int, Option("Seed of the random times.")] = 0,
    assume: A[
        float | None,
        Option(
            "Share of its period that a cycle takes whose MAXC is unknown.",
            "SHARE",
            least=0.0,
            most=1.0,
        ),
    ] = None,
    code: A[bool, Option("Run the modules' code too.")] = False,
    show: A[
        float,
        Option(
            "Length of the chart; 0 is four of the longest periods.",
            "SECONDS",
            least=0.0,
        ),
    ] = 0.0,
    svg: A[
        Path | None,
        Option("Draw the chart into a file; one for each of several RTPUs.", "FILE"),
    ] = None,
    ascii_: A[bool, Option("Draw the chart in plain characters.")] = False,
    host: options.Host = "",
    library: options.Library = None,
    json_: options.Json = False,
) -> None:
    """Simulate the schedule of a job: chart, deadlines, response times.

    'pbonet run --sim' runs the job itself in virtual time, with its log.

    Examples:
        Show whether all deadlines are met if every cycle takes its longest:
        pbonet simulate puma.job
        Draw one second of the schedule with random times as they were measured:
        pbonet simulate puma.job --times random --show 1 --svg chart.svg
    """
    from pbonet.analysis.legality import Times
    from pbonet.analysis.schedule import chart
    from pbonet.master.tools import schedule_job

    outcome, warnings = schedule_job.simulate(
        file,
        seconds,
        library or (),
        host=host,
        times=Times(times),
        seed=seed,
        assume=assume,
        code=code,
    )
    show_ns = round(show * 1e9)
    files = schedule_job.write_svg(outcome, svg, show_ns) if svg else []
    text = outcome.as_text(show_ns=show_ns, marks=chart.ASCII if ascii_ else None)
    data = outcome.as_data() | {"files": list(map(str, files))}
    options.show_warned(text, data, warnings, as_data=json_)
