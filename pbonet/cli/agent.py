"""``pbonet agent``: be the agent of one RTPU until a signal ends it."""

from __future__ import annotations

import logging
import os
import signal
from functools import partial
from pathlib import Path
from typing import Annotated as A, Literal

from .parser import Option


def command(
    *,
    name: A[str | None, Option("The RTPU's name.", "NAME")] = None,
    core: A[
        int | None,
        Option("The core its tasks run on; chosen if left out.", "CORE", least=0),
    ] = None,
    config: A[Path | None, Option("An agent.toml with these settings.", "FILE")] = None,
    domain: A[
        str | None,
        Option(
            "The domain: RTPUs and masters of one domain find each other.",
            "NAME",
            env="PBONET_DOMAIN",
        ),
    ] = None,
    listen: A[list[str] | None, Option("Accept connections there.", "ENDPOINT")] = None,
    connect: A[
        list[str] | None,
        Option("Connect to this agent.", "ENDPOINT", env="PBONET_CONNECT"),
    ] = None,
    router: A[
        list[str] | None,
        Option(
            "Connect to this router (pbonet router), or to the next one named.",
            "ENDPOINT",
            env="PBONET_ROUTER",
        ),
    ] = None,
    library: A[
        list[Path] | None,
        Option("A folder of modules.", "FOLDER", env="PBONET_LIBRARY"),
    ] = None,
    grace: A[
        float | None,
        Option("How long tasks go on if the agent dies.", "SECONDS", least=0),
    ] = None,
    keys: A[
        Path | None,
        Option(
            "Its folder of certificates (pbonet keys).", "FOLDER", env="PBONET_KEYS"
        ),
    ] = None,
    runs: A[
        Path | None,
        Option("Folder of the logs; PBONET_RUNS or runs by default.", "FOLDER"),
    ] = None,
    files: A[
        Path | None,
        Option("A folder that tasks elsewhere may read: pbonet://NAME/...", "FOLDER"),
    ] = None,
    insecure: A[bool, Option("Accept other machines without certificates.")] = False,
    multicast: A[
        bool, Option("Find the domain's agents on the local network.")
    ] = False,
    awake: A[bool, Option("Keep the processors out of their sleep states.")] = False,
    backend: A[
        Literal["auto", "fifo", "park"],
        Option("How tasks are scheduled: by real-time priority, or parked."),
    ] = "auto",
    with_parent: A[int, Option("End when this parent process ends.", "PID")] = 0,
    verbose: A[bool, Option("Log what happens.", names=("--verbose", "-v"))] = False,
) -> int:
    """Start the agent of an RTPU (executor), which runs tasks on its core.

    It runs until SIGTERM or Ctrl-C. 'pbonet run' starts agents where there are none.

    Examples:
        Start RTPU arm0 on core 1:
        pbonet agent --name arm0 --core 1
        Start one that other machines can reach, configured by a file:
        pbonet agent --config agent.toml --listen tcp/0.0.0.0:7447 --keys keys/arm0
    """
    from pbonet.config import agent_settings
    from pbonet.node.agent import agent_main

    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    if with_parent and not _end_with(with_parent):
        return 0
    told = {
        "name": name,
        "core": core,
        "domain": domain,
        "listen": listen,
        "connect": connect,
        "routers": router,
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
    read = partial(agent_settings, config, given)
    lasts = not with_parent  # the parent's job ends with the parent
    return agent_main.main(read(), backend=backend, again=read, lasts=lasts)


def _end_with(parent: int) -> bool:
    """Let this process end when its parent does; return whether that still lives."""
    from pbonet.node.wire import process_setup

    return process_setup.on_end_of_parent(
        parent, lambda: os.kill(os.getpid(), signal.SIGTERM)
    )
