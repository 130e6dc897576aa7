"""Commands that a living master carries out for another program."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.errors import NoAnswerError, PbonetError, UnreachableError
from pbonet.master.subsystem import client_name
from pbonet.xm.net import codec, key_expressions, messages as m, rpc

from .command_session import Call, Reply
from .network_interface import Order

if TYPE_CHECKING:
    from collections.abc import Mapping

    import zenoh

    from pbonet.master.configuration import Files, Place

_PAUSE = 0.05
_OF_JOB = {"start", "switch"}
"""Commands that mean the job of the file that was named, if they name none."""
_FORWARD_TIME = 60.0
"""Seconds that a command may take which a master carries out for us."""


def through_master(
    opened: zenoh.Session,
    place: Place,
    files: Files,
    call: Call,
    kind: str = "",
) -> Reply | None:
    """Have a living master carry out a command; None if none serves the port.

    The session is closed unless there is none.
    """
    name = files.sbs.subsystem
    args = call.words
    command = call.command.name
    if files.job is not None and command in _OF_JOB and "job" not in args:
        # The master has a job of its own.
        args = {**args, "job": str(Path(files.job.file).resolve())}
    caller = client_name(kind or command.replace(" ", "-"))
    client = rpc.Client(opened, place.domain, caller)
    try:
        if not client.tokens(key_expressions.network(place.domain, name)):
            return None
        reply = ask(client, name, command, args)
    except BaseException:
        client.close()
        raise
    client.close()
    return reply


def ask(
    client: rpc.Client, port: str, command: str, args: Mapping[str, object]
) -> Reply:
    """Send a command to the port of a master, and return its reply.

    Raises:
        UnreachableError: The port is not served, or no longer.
        NoAnswerError: The master does not answer.
        PbonetError: The command failed; the error has the class that the master
            reports.
    """
    order = Order(
        id=os.urandom(8).hex(),
        client=client.name,
        command=command,
        args={name: value for name, value in args.items() if value is not None},
    )
    key = key_expressions.network(client.domain, port)
    payload = msgspec.msgpack.encode(order)
    deadline = time.monotonic() + rpc.ANSWER_TIME
    while True:
        for reply in client.session.get(key, payload=payload, timeout=_FORWARD_TIME):
            if reply.ok is None:
                raise NoAnswerError(
                    f"the master did not answer within {_FORWARD_TIME:g} s",
                    where=key,
                    remedy="see the master's output; 'pbonet stop' needs no master",
                )
            return _reply(codec.Codec().answer(reply.ok.payload.to_bytes()))
        if not client.tokens(key):
            raise UnreachableError(
                "the master has ended",
                where=key,
                remedy="give the command again: it needs no other master then",
            )
        if time.monotonic() > deadline:
            raise NoAnswerError(
                "the master is there, but does not take commands",
                where=key,
                remedy="give the command again; 'pbonet stop' needs no master",
            )
        time.sleep(_PAUSE)  # its port was opened a moment ago


def _reply(answer: m.Answer) -> Reply:
    if not answer.ok:
        raise PbonetError.from_wire(answer.error or {})
    result: dict[str, Any] = answer.result or {}
    return Reply(
        command=result.get("command", ""),
        data=result.get("data", {}),
        warnings=answer.warnings,
    )
