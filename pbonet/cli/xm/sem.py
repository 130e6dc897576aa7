"""``pbonet sem``: semaphores of all machines."""

from __future__ import annotations

from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option

from . import shared_arguments as shared

HELP = "List, make, give, take and remove semaphores of all machines."

Name = A[str, Argument("RTPU:NAME, or NAME of a program's own.", "SEMAPHORE")]


def ls(
    *,
    rtpus: shared.Rtpus = None,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """List semaphores: value, maximum, holder and number of waits.

    Examples:
        Show those of all machines that are reached:
        pbonet sem ls
        Show those of one RTPU:
        pbonet sem ls arm0
    """
    shared.show_list(
        "sem",
        rtpus,
        reach,
        ("value", "maximum", "kind", "holder", "waiting"),
        lambda one: (
            one.value,
            one.settings["maximum"],
            "binary" if one.settings["binary"] else "counting",
            one.holder,
            one.waiting,
        ),
        as_data=json_,
    )


def new(
    *,
    name: Name,
    initial: A[int, Option("Its value.", least=0)] = 1,
    maximum: A[int | None, Option("Its highest value.", least=1)] = None,
    binary: A[bool, Option("For a critical section: the holder is known.")] = False,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Make a semaphore, which stays until it is removed or its RTPU ends.

    Examples:
        Make one that counts parts, from none:
        pbonet sem new arm0:parts --initial 0
        Make one for a critical section:
        pbonet sem new arm0:grip --binary
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    express_mail.make_semaphore(name, initial=initial, maximum=maximum, binary=binary)
    options.show("", {"name": name}, as_data=json_)


def put(
    *,
    name: Name,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Give one unit (V): the next that waits for it gets it.

    Examples:
        Let a task go on that waits for a signal:
        pbonet sem put arm0:go
        Give one and print the value that it has then, as data:
        pbonet sem put arm0:parts --json
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    value = express_mail.give(name)
    options.show(f"{name} {value}", {"name": name, "value": value}, as_data=json_)


def get(
    *,
    name: Name,
    wait: shared.Wait = 0.0,
    priority: shared.Priority = 0,
    run: A[
        str, Option("Hold it while this command runs, then give it back.", "COMMAND")
    ] = "",
    reach: options.Agents,
    json_: options.Json = False,
) -> int:
    """Take one unit (P), or hold it while a command runs.

    A binary semaphore needs --run: its holder is a process, and one that ends without
    giving it back counts as died. The status is then the command's.

    Examples:
        Take one, and wait for it up to five seconds:
        pbonet sem get arm0:parts --wait 5
        Calibrate while no task uses the gripper:
        pbonet sem get arm0:grip --wait 10 --run ./calibrate.sh
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    taken, status = express_mail.take(name, wait=wait, priority=priority, run=run)
    died = taken.name == "HOLDER_DIED"
    warning = f"{name}: the last holder died with it; check what it guards"
    data = {"name": name, "holder_died": died, "status": status}
    options.show_warned("", data, [warning] if died else [], as_data=json_)
    return status


def rm(
    *,
    name: Name,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Remove a semaphore; its users get an error.

    Examples:
        Remove one:
        pbonet sem rm arm0:parts
        Remove one of another machine:
        pbonet sem rm arm1:grip --connect tcp/10.0.0.2:7447
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    express_mail.remove(name, "sem")
    options.show("", {"name": name}, as_data=json_)


COMMANDS = (ls, new, put, get, rm)
