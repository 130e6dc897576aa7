"""Options that many verbs have, declared once."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated as A

import typer

from pbonet.xm.net import credentials


class Chosen:
    """What the error handler must know of the command line."""

    def __init__(self) -> None:
        self.json = False
        self.debug = False


chosen = Chosen()


def _json(value: bool) -> bool:
    chosen.json = chosen.json or value
    return value


def _debug(value: bool) -> bool:
    chosen.debug = chosen.debug or value
    return value


def _keys(value: Path | None) -> Path | None:
    if value is not None:
        os.environ[credentials.VARIABLE] = str(value.absolute())
    return value


def _version(value: bool) -> None:
    if value:
        import pbonet

        typer.echo(f"pbonet {pbonet.__version__}")
        raise typer.Exit


File = A[
    Path,
    typer.Argument(help="The .sbs file, or a .job file that names it.", metavar="FILE"),
]
Json = A[bool, typer.Option("--json", help="Give data.", callback=_json, is_eager=True)]
Debug = A[
    bool,
    typer.Option(
        "--debug",
        help="Add the stack to an error's message.",
        callback=_debug,
        is_eager=True,
    ),
]
Domain = A[
    str,
    typer.Option(
        help="The domain of the RTPUs.", envvar="PBONET_DOMAIN", metavar="NAME"
    ),
]
Connect = A[
    list[str] | None,
    typer.Option(
        help="An agent on another machine, such as tcp/10.0.0.2:7447.",
        envvar="PBONET_CONNECT",
        metavar="ENDPOINT",
    ),
]
Keys = A[
    Path | None,
    typer.Option(
        help="Your key folder (pbonet keys).",
        envvar=credentials.VARIABLE,
        metavar="FOLDER",
        callback=_keys,
    ),
]
Library = A[
    list[Path] | None,
    typer.Option(
        help="A folder with RMODs and modules of your own.",
        envvar="PBONET_LIBRARY",
        metavar="FOLDER",
    ),
]
Host = A[
    str,
    typer.Option(
        help="The machine whose saved profiles count; this one if left out.",
        metavar="NAME",
    ),
]
TakeOver = A[
    bool, typer.Option("--take-over", help="Replace a master that is still there.")
]
Version = A[
    bool,
    typer.Option(
        "--version", help="Show the version.", callback=_version, is_eager=True
    ),
]


def version(version: Version = False) -> None:
    """Assemble a robot's control software from ready modules, change it as it runs."""


def show_files(
    paths: Sequence[Path], told: Sequence[str] = (), *, as_data: bool
) -> None:
    """Print which files a verb has written, and what is to be said of them."""
    names = list(map(str, paths))
    if as_data:
        typer.echo(json.dumps({"files": names, "warnings": list(told)}))
        return
    typer.echo("\n".join(names))
    for text in told:
        typer.echo(f"WARNING> {text}", err=True)
