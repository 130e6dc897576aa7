"""``pbonet replay``: run what was recorded again, or play it to others."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated as A

import typer

from . import options


def command(
    *,
    run: A[Path, typer.Argument(help="A log, or a run's folder.", metavar="RUN")],
    tasks: A[list[str] | None, typer.Argument(help="Which; all.")] = None,
    verify: A[
        bool,
        typer.Option(
            "--verify", help="Each by itself, on recorded inputs, to the first other."
        ),
    ] = False,
    out: A[
        Path | None,
        typer.Option("--out", "-o", help="Without --verify: write what they give now."),
    ] = None,
    rtol: A[
        float, typer.Option(help="How far floats may be off, relative.", min=0.0)
    ] = 0.0,
    play: A[
        str | None,
        typer.Option(
            help="Put what these tasks wrote into the table of the running subsystem.",
            metavar="TASK,...",
        ),
    ] = None,
    rate: A[
        float, typer.Option(help="How many times as fast it is played.", min=1e-3)
    ] = 1.0,
    start: A[
        float, typer.Option(help="Seconds since the run began.", metavar="S", min=0.0)
    ] = 0.0,
    end: A[
        float | None, typer.Option(help="The same, of the end.", metavar="S", min=0.0)
    ] = None,
    loop: A[bool, typer.Option("--loop", help="Play it over and over.")] = False,
    subsystem: A[
        str, typer.Option(help="Where it is played; that of the log.", metavar="NAME")
    ] = "",
    json_: options.Json = False,
    domain: options.Domain = "default",
    library: options.Library = None,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Run the code of recorded tasks again together, each by itself, or play them."""
    import msgspec

    from pbonet import testing
    from pbonet.errors import StateError
    from pbonet.master.tools import playback

    span = playback.Span(rate=rate, start=start, end=end, loop=loop)
    names = [name for task in (play or "").split(",") if (name := task.strip())]
    if play is not None and (verify or tasks or out or not names):
        raise StateError(
            "--play goes with a rate and a part of the run, and with nothing else",
            expected="pbonet replay RUN --play TASK,...",
            remedy=f"pbonet replay {run} --play {','.join(names) or 'TASK'}",
        )
    if play is None and (span != playback.Span() or subsystem):
        raise StateError(
            "--rate, --start, --end, --loop and --subsystem go with --play only",
            expected="pbonet replay RUN --play TASK,... --rate 2",
            remedy="leave them out: code is run again as fast as it goes, and whole",
        )
    if verify and out:
        raise StateError(
            "--out goes without --verify, which makes nothing that could be written",
            expected="pbonet replay RUN --out FILE, or pbonet replay RUN --verify",
            remedy=f"pbonet replay {run} --out {out}",
        )
    libraries = library or ()
    result: object
    status = 0
    if play is not None:
        for one in (signal.SIGINT, signal.SIGTERM):  # a shell may have ignored one
            signal.signal(one, signal.default_int_handler)
        result = playback.play(run, names, span, domain=domain, subsystem=subsystem)
    elif verify:
        result = testing.verify(run, tasks or (), libraries=libraries, rtol=rtol)
        status = int(not all(one.good for one in result))
    else:
        result = testing.rerun(
            run, tasks or (), libraries=libraries, rtol=rtol, out=out
        )
        status = int(not result.good)
    if json_:
        print(msgspec.json.encode(result).decode())
    else:
        print("\n".join(map(str, result if isinstance(result, list) else [result])))
    raise typer.Exit(status)
