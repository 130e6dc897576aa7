"""``pbonet agent``: be the agent of one RTPU until told to end."""

from __future__ import annotations

import enum
import logging
import signal
from functools import partial
from pathlib import Path
from typing import Annotated as A

import typer

from . import options


class Backend(enum.StrEnum):
    """How tasks are scheduled."""

    AUTO = "auto"
    FIFO = "fifo"
    PARK = "park"


def command(
    *,
    name: A[str | None, typer.Option(help="The RTPU's name.")] = None,
    core: A[
        int | None, typer.Option(help="The core it owns; chosen if left out.", min=0)
    ] = None,
    config: A[Path | None, typer.Option(help="An agent.toml.")] = None,
    domain: A[
        str | None,
        typer.Option(help="The domain.", envvar="PBONET_DOMAIN", metavar="NAME"),
    ] = None,
    listen: A[
        list[str] | None, typer.Option(help="Listen there.", metavar="ENDPOINT")
    ] = None,
    connect: A[
        list[str] | None,
        typer.Option(
            help="Connect there.", envvar="PBONET_CONNECT", metavar="ENDPOINT"
        ),
    ] = None,
    library: A[
        list[Path] | None,
        typer.Option(
            help="A folder of modules.", envvar="PBONET_LIBRARY", metavar="FOLDER"
        ),
    ] = None,
    grace: A[
        float | None,
        typer.Option(help="Seconds that control goes on without the agent.", min=0),
    ] = None,
    keys: A[
        Path | None,
        typer.Option(
            help="Its key folder (pbonet keys).",
            envvar="PBONET_KEYS",
            metavar="FOLDER",
        ),
    ] = None,
    runs: A[
        Path | None,
        typer.Option(help="Folder of the logs; PBONET_RUNS or runs by default."),
    ] = None,
    files: A[
        Path | None,
        typer.Option(help="Folder that others may use: pbonet://NAME/..."),
    ] = None,
    insecure: A[
        bool, typer.Option("--insecure", help="Listen beyond this machine.")
    ] = False,
    multicast: A[
        bool, typer.Option("--multicast", help="Find the domain's agents nearby.")
    ] = False,
    awake: A[
        bool, typer.Option("--awake", help="Keep the processors from sleeping.")
    ] = False,
    backend: A[Backend, typer.Option(help="Scheduling.")] = Backend.AUTO,
    with_parent: A[
        int, typer.Option(help="End with this parent process.", metavar="PID")
    ] = 0,
    verbose: A[bool, typer.Option("--verbose", "-v", help="Say what happens.")] = False,
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Be the agent of one RTPU: register, take commands, run tasks."""
    from pbonet.config import told_agent
    from pbonet.node.agent import agent_main
    from pbonet.node.wire import process_setup

    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    if with_parent and not process_setup.set_parent_death_signal(
        signal.SIGTERM, with_parent
    ):
        raise typer.Exit(0)
    told = {
        "name": name,
        "core": core,
        "domain": domain,
        "listen": listen,
        "connect": connect,
        "libraries": [str(folder) for folder in library] if library else None,
        "grace": grace,
        "keys": str(keys.absolute()) if keys else None,
        "runs": str(runs) if runs else None,
        "files": str(files) if files else None,
        "insecure": insecure or None,
        "multicast": multicast or None,
        "awake": awake or None,
    }
    given = {key: value for key, value in told.items() if value is not None}
    read = partial(told_agent, config, given)
    raise typer.Exit(agent_main.main(read(), backend=backend.value, again=read))
