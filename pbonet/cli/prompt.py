"""``pbonet prompt``: the prompt, a script, the network interface, or all of them."""

from __future__ import annotations

import sys
from typing import Annotated as A

from . import options
from .parser import Option


def command(
    *,
    file: options.File,
    script: A[
        list[str] | None,
        Option("Carry out this file's commands; - is standard input.", "FILE"),
    ] = None,
    network: A[
        str | None,
        Option("Then take commands from a program on the network.", "PORTNAME"),
    ] = None,
    prompt: A[
        bool | None,
        Option("Then open the prompt; the default without the two above."),
    ] = None,
    leave: A[bool, Option("Leave the tasks running at the end.")] = False,
    keep_going: A[bool, Option("Go on after a command that failed.")] = False,
    place: options.ChangeTransaction,
    json_: options.Json = False,
    debug: options.Debug = False,
) -> int:
    """Open the prompt of a subsystem; or run a script, or serve a program.

    Tab completes commands, and 'help' explains them. F12 or Ctrl-E stops the subsystem
    at any moment. At the end all tasks are turned off and destroyed, except with
    --leave.

    Examples:
        Steer a subsystem by hand:
        pbonet prompt arm.sbs
        Carry out a script, and leave its tasks running:
        pbonet prompt arm.sbs --script warmup.txt --leave
    """
    from pbonet.master.console import interfaces

    scripts = script or ([] if sys.stdin.isatty() or network else [interfaces.STDIN])
    return interfaces.run(
        file,
        place,
        scripts=scripts,
        network=network,
        prompt=not (scripts or network) if prompt is None else prompt,
        leave=leave,
        keep_going=keep_going,
        as_data=json_,
        debug=debug,
    )
