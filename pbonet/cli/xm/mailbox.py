"""``pbonet mailbox``: mailbox interrupts of all machines."""

from __future__ import annotations

from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option

from . import shared_arguments as shared

HELP = "List mailboxes of all machines, send interrupts, take and remove them."

Name = A[str, Argument("RTPU:NAME, or NAME of a program's own.", "MAILBOX")]


def ls(
    *,
    rtpus: shared.Rtpus = None,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """List mailboxes: pending, sent and refused interrupts, handler.

    Examples:
        Show those of all machines that are reached:
        pbonet mailbox ls
        Show those of one RTPU as data:
        pbonet mailbox ls arm1 --json
    """
    shared.show_list(
        "mailbox",
        rtpus,
        reach,
        ("pending", "depth", "sent", "refused", "handler"),
        lambda one: (
            one.value,
            one.settings["messages"],
            one.sent,
            one.dropped,
            one.holder,
        ),
        as_data=json_,
    )


def put(
    *,
    name: Name,
    value: A[int, Argument("The value that its handler gets.")] = 1,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Send an interrupt with a value; it is kept until it is handled.

    Examples:
        Tell a task that the door is open:
        pbonet mailbox put arm1:door 3
        Send the value 1 to a program of this machine:
        pbonet mailbox put bell
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    express_mail.interrupt(name, value)
    options.show("", {"name": name, "value": value}, as_data=json_)


def get(
    *,
    name: Name,
    count: A[int, Option("The most interrupts to take.", least=1)] = 1,
    wait: A[
        float,
        Option("How long it waits for the first one.", "SECONDS", least=0.0, most=1e8),
    ] = 0.0,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Take interrupts of a mailbox on this machine, as its handler.

    A mailbox that is not there is installed. One with a living handler is refused: a
    mailbox has one handler.

    Examples:
        Wait for an interrupt, up to a minute, and print its value:
        pbonet mailbox get arm0:door --wait 60
        Print all values that wait:
        pbonet mailbox get arm0:door --count 64
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    values = express_mail.handle(name, wait=wait, count=count)
    data = {"name": name, "values": values}
    options.show("\n".join(map(str, values)), data, as_data=json_)


def rm(
    *,
    name: Name,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Remove a mailbox with its interrupts; its senders get an error.

    Examples:
        Remove one whose program no longer exists:
        pbonet mailbox rm arm1:door
        Remove one of this machine's programs:
        pbonet mailbox rm bell
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    express_mail.remove(name, "mailbox")
    options.show("", {"name": name}, as_data=json_)


COMMANDS = (ls, put, get, rm)
