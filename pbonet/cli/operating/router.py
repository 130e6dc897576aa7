"""``pbonet router``: be a router for the agents and masters of many machines."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Annotated as A

from pbonet.cli.parser import Option


def command(
    *,
    config: A[
        Path | None, Option("A configuration file of zenoh (JSON5).", "FILE")
    ] = None,
    listen: A[
        list[str] | None, Option("Accept agents and masters there.", "ENDPOINT")
    ] = None,
    connect: A[
        list[str] | None,
        Option(
            "Keep a link to this router; only one of two names the other.", "ENDPOINT"
        ),
    ] = None,
    keys: A[
        Path | None,
        Option("Its folder of certificates: those of a gateway.", "FOLDER"),
    ] = None,
    insecure: A[bool, Option("Accept other machines without certificates.")] = False,
    show: A[bool, Option("Print the configuration, for zenohd, and end.")] = False,
    verbose: A[bool, Option("Log what happens.", names=("--verbose", "-v"))] = False,
) -> int:
    """Start a router that connects agents and masters of many machines.

    It is zenoh's router and takes zenohd's configuration file; options replace what the
    file says. It runs until SIGTERM or Ctrl-C. Agents are its clients with --router.

    Examples:
        Start the router of a laboratory:
        pbonet router --keys keys/router --listen tls/0.0.0.0:7447
        Start a second one, linked to the first:
        pbonet router --config router.json5 --connect tls/10.0.0.8:7447
        Write a file for zenohd:
        pbonet router --keys keys/router --listen tls/0.0.0.0:7447 --show
    """
    from pbonet.router import router_config, router_process

    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    told = router_config.read(
        config,
        listen=listen or (),
        connect=connect or (),
        key_folder=keys.absolute() if keys else None,
        insecure=insecure,
    )
    if show:
        sys.stdout.write(router_config.show(told))
        return 0
    return router_process.main(told)
