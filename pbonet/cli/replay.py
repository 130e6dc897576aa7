"""``pbonet replay``: run what was recorded again, or play it to others."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from typing import Annotated as A

import typer

from pbonet.cli import options

if TYPE_CHECKING:
    from pbonet.testing import Verdict


def command(
    *,
    run: A[Path, typer.Argument(help="A log, or a run's folder.", metavar="RUN")],
    tasks: A[list[str] | None, typer.Argument(help="Which; all.")] = None,
    verify: A[
        bool, typer.Option("--verify", help="Compare what their code gives now.")
    ] = False,
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
    """Run the code of recorded tasks again, or play what they wrote to others."""
    import msgspec

    from pbonet.errors import StateError
    from pbonet.master import player
    from pbonet.testing import verify as run_again

    if verify == (play is not None) or (tasks and not verify):
        raise StateError(
            "it was not said what is to be done with the log",
            expected="either --verify or --play",
            got="both" if verify else "neither",
            remedy=f"pbonet replay {run} --verify",
        )
    results: list[player.Played] | list[Verdict]
    if play is not None:
        span = player.Span(rate=rate, start=start, end=end, loop=loop)
        names = [task.strip() for task in play.split(",")]
        results = player.play(run, names, span, domain=domain, subsystem=subsystem)
        status = 0
    else:
        results = run_again(run, tasks or (), libraries=library or (), rtol=rtol)
        status = int(any(one.divergence is not None for one in results))
    if json_:
        print(msgspec.json.encode(results).decode())
    else:
        print("\n".join(map(str, results)))
    raise typer.Exit(status)
