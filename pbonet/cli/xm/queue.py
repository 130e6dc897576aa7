"""``pbonet queue``: message queues of all machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated as A, Literal

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option

from . import shared_arguments as shared

HELP = "List, make, fill, empty and remove message queues of all machines."

Name = A[str, Argument("RTPU:NAME, or NAME of a program's own.", "QUEUE")]
_POLICIES = ("FIFO", "LIFO", "HPF")


def ls(
    *,
    rtpus: shared.Rtpus = None,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """List queues: messages, policy, waits, sent and dropped ones.

    Examples:
        Show those of all machines that are reached:
        pbonet queue ls
        Show those of one RTPU as data:
        pbonet queue ls arm0 --json
    """
    shared.show_list(
        "queue",
        rtpus,
        reach,
        ("messages", "most", "policy", "waiting", "sent", "dropped"),
        lambda one: (
            one.value,
            one.settings["messages"],
            _POLICIES[one.settings["policy"]],
            one.waiting,
            one.sent,
            one.dropped,
        ),
        as_data=json_,
    )


def new(
    *,
    name: Name,
    policy: A[
        Literal["fifo", "lifo", "hpf"],
        Option("Order in which messages are received; hpf: highest priority first."),
    ] = "fifo",
    messages: A[int, Option("The most that it holds.", least=1)] = 64,
    block: A[int, Option("Bytes of a block; a message takes several.", least=8)] = 64,
    blocks: A[int | None, Option("How many; one a message.", least=1)] = None,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Make a queue, which stays until it is removed or its RTPU ends.

    Examples:
        Make one for orders, of which urgent ones go first:
        pbonet queue new arm0:orders --policy hpf
        Make one for ten long messages:
        pbonet queue new arm0:maps --messages 10 --block 65536
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    express_mail.make_queue(
        name, policy=policy, messages=messages, block=block, blocks=blocks
    )
    options.show("", {"name": name}, as_data=json_)


def put(
    *,
    name: Name,
    text: A[str | None, Argument("The message, as text.")] = None,
    file: A[Path | None, Option("Send what a file holds; - is standard input.")] = None,
    hex_: A[str | None, Option("Send bytes given as hexadecimal digits.")] = None,
    priority: A[
        int,
        Option(
            "Of the message, for queues of policy hpf.",
            least=shared.LEAST,
            most=shared.MOST,
        ),
    ] = 0,
    wait: A[float, Option("Wait for room.", "SECONDS", least=0.0, most=1e8)] = 0.0,
    full: A[
        Literal["refuse", "drop", "drop-oldest"], Option("If there is no room then.")
    ] = "refuse",
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Send a message.

    Examples:
        Send a text with a priority:
        pbonet queue put arm0:orders 'fetch 3' --priority 2
        Send what comes on standard input:
        pbonet queue put arm0:orders --file -
    """
    from pbonet.master.tools import express_mail

    data = shared.message(text, file, hex_)
    shared.settle(reach)
    done = express_mail.send(name, data, priority=priority, wait=wait, full=full)
    about = {"name": name, "bytes": len(data), "sent": done}
    options.show("" if done else "dropped", about, as_data=json_)


def get(
    *,
    name: Name,
    count: A[int, Option("The most messages to receive.", least=1)] = 1,
    wait: A[
        float,
        Option("How long it waits for the first one.", "SECONDS", least=0.0, most=1e8),
    ] = 0.0,
    priority: shared.Priority = 0,
    out: A[
        Path | None,
        Option(
            "Write the bytes of the messages into a file.",
            "FILE",
            names=("--out", "-o"),
        ),
    ] = None,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Receive messages and print them.

    A message that is no text is printed as hexadecimal digits.

    Examples:
        Receive one, and wait for it up to five seconds:
        pbonet queue get arm0:done --wait 5
        Receive all that wait, up to 100, as data:
        pbonet queue get arm0:done --count 100 --json
    """
    import msgspec

    from pbonet.master.tools import express_mail, remote_files

    shared.settle(reach)
    if out is not None:
        remote_files.must_be_writable(out)  # else what is received would be lost
    found = express_mail.receive(name, wait=wait, count=count, priority=priority)
    made = [express_mail.message(*one) for one in found]
    text = "\n".join(one.hex if one.text is None else one.text for one in made)
    data = {"name": name, "messages": msgspec.to_builtins(made)}
    if out is not None:
        remote_files.write_bytes(out, b"".join(data for data, _ in found))
        text, data = str(out), data | {"file": str(out)}
    options.show(text, data, as_data=json_)


def rm(
    *,
    name: Name,
    reach: options.Agents,
    json_: options.Json = False,
) -> None:
    """Remove a queue with its messages; its users get an error.

    Examples:
        Remove one:
        pbonet queue rm arm0:orders
        Remove one of another machine:
        pbonet queue rm arm1:done --connect tcp/10.0.0.2:7447
    """
    from pbonet.master.tools import express_mail

    shared.settle(reach)
    express_mail.remove(name, "queue")
    options.show("", {"name": name}, as_data=json_)


COMMANDS = (ls, new, put, get, rm)
