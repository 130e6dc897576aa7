"""``pbonet ros2``: a subsystem as a node of ROS 2, without ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Option

HELP = "Make a subsystem a node of ROS 2, with rmw_zenoh."


def bridge(
    *,
    file: options.File,
    topics: A[
        Path | None,
        Option("Which topics (docs/ros2.md); all variables if left out.", "FILE"),
    ] = None,
    router: A[
        str, Option("The router of ROS 2; tcp/localhost:7447 if left out.", "ENDPOINT")
    ] = "",
    listen: A[
        str, Option("Serve as ROS 2's router at this endpoint.", "ENDPOINT")
    ] = "",
    control: A[
        bool, Option("Let nodes change the subsystem: on, off, swap, set.")
    ] = False,
    insecure: A[bool, Option("Listen beyond this machine, unprotected.")] = False,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Publish variables as topics, and topics as links, until Ctrl-C.

    Examples:
        Show the variables to nodes whose router runs on this machine:
        pbonet ros2 bridge arm.sbs
        Serve as their router, and publish what a file says:
        pbonet ros2 bridge arm.sbs --listen tcp/localhost:7447 --topics arm.toml
        Let them command the subsystem, too:
        pbonet ros2 bridge arm.sbs --control
    """
    from pbonet.ros2 import bridge as process

    process.run(
        file,
        place,
        topics,
        process.Network(router, listen, insecure),
        control=control,
        as_data=json_,
    )


COMMANDS = (bridge,)
