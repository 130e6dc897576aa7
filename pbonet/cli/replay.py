"""``pbonet replay``: run what was recorded again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

import typer

from pbonet.cli import options


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
    library: options.Library = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Run the code of recorded tasks again, and say where it gives something else."""
    import msgspec

    from pbonet.errors import StateError
    from pbonet.testing import verify as run_again

    if not verify:
        raise StateError(
            "nothing was asked for",
            expected="--verify",
            remedy=f"pbonet replay {run} --verify",
        )
    verdicts = run_again(run, tasks or (), libraries=library or (), rtol=rtol)
    if json_:
        print(msgspec.json.encode(verdicts).decode())
    else:
        print("\n".join(map(str, verdicts)))
    raise typer.Exit(int(any(one.divergence is not None for one in verdicts)))
