"""``pbonet keys``: certificates of agents, masters and observers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

import typer

from . import options

command = typer.Typer(
    help="Make certificates for agents, masters and observers.", no_args_is_help=True
)

Authority = A[
    Path, typer.Option("--ca", help="The authority's folder.", metavar="FOLDER")
]
Name = A[str, typer.Argument(help="The holder: a machine or a person.")]
Days = A[float, typer.Option(help="How long it is good for, days.", min=0.0)]
Out = A[
    Path | None,
    typer.Option("--out", help="Where it is put; CA/NAME.", metavar="FOLDER"),
]
HERE = Path("keys")
LONG = 825.0


@command.command("ca")
def authority(
    *,
    folder: Authority = HERE,
    name: A[str, typer.Option(help="What the laboratory is called.")] = "pbonet",
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Make the authority that signs for a laboratory; keep its ca.key to yourself."""
    from pbonet.xm.net import pki

    options.show_files([pki.make_authority(folder, name)], as_data=json_)


@command.command("agent")
def agent(
    *,
    name: Name,
    host: A[
        list[str] | None,
        typer.Option(help="A name or address by which others connect to it."),
    ] = None,
    folder: Authority = HERE,
    days: Days = LONG,
    out: Out = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Make the keys of a machine that runs agents."""
    from pbonet.xm.net import credentials, pki

    made = pki.issue(
        folder, credentials.Role.AGENT, name, hosts=host or (), days=days, folder=out
    )
    options.show_files([made], as_data=json_)


@command.command("master")
def master(
    *,
    name: Name,
    folder: Authority = HERE,
    days: Days = LONG,
    out: Out = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Make the keys of somebody who may steer."""
    from pbonet.xm.net import credentials, pki

    made = pki.issue(folder, credentials.Role.MASTER, name, days=days, folder=out)
    options.show_files([made], as_data=json_)


@command.command("observer")
def observer(
    *,
    name: Name,
    folder: Authority = HERE,
    days: Days = LONG,
    out: Out = None,
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Make the keys of somebody who may look, and steer nothing."""
    from pbonet.xm.net import credentials, pki

    made = pki.issue(folder, credentials.Role.OBSERVER, name, days=days, folder=out)
    options.show_files([made], as_data=json_)


@command.command("show")
def show(
    *,
    folders: A[list[Path], typer.Argument(help="Key folders.", metavar="FOLDER")],
    json_: options.Json = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Show whose keys these are, and how long they are good for."""
    import msgspec

    from pbonet.xm.net import pki

    found = [pki.read(folder) for folder in folders]
    if json_:
        print(msgspec.json.encode(found).decode())
        return
    for one in found:
        hosts = f" at {', '.join(one.hosts)}" if one.hosts else ""
        state = f"{one.days:.0f} days left" if one.days > 0 else "OVER"
        print(f"{one.name}: {one.role.value}{hosts}, until {one.until} ({state})")
