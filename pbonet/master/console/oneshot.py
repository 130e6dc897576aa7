"""One command given from outside, and then gone again: the verbs of the command line.

A verb that only looks claims nothing. A verb that changes something is a master for a
moment: it claims the subsystem, acts, and leaves, and the tasks go on. Where a master
lives that serves the port of the subsystem's name (``pbonet run`` does), the verb asks
that master instead of being refused.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import zenoh

from pbonet.config import Library
from pbonet.errors import (
    NoAnswerError,
    NodeError,
    PbonetError,
    UnreachableError,
    did_you_mean,
)
from pbonet.master.configuration import Files, must_be_stopped
from pbonet.master.subsystem import Subsystem, client_name
from pbonet.xm.net import (
    codec,
    key_expressions,
    messages as m,
    rpc,
    run_folder,
    session,
)

from .command_session import Call, Desk, Reply, convert
from .commands import find
from .network_interface import Order

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pbonet.master.configuration import Place

_PAUSE = 0.05
_FORWARD_TIME = 60.0
"""Seconds that a command may take which a master carries out for us."""


def run(
    path: str | Path, command: str, args: Mapping[str, object], place: Place
) -> Reply:
    """Carry out one command on a subsystem and leave it.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        command: The command's name.
        args: Its arguments, by name.
        place: Where the subsystem is.

    Raises:
        PbonetError: A file, an argument or an agent is wrong, or the command failed.
    """
    wanted = find(command)
    call = Call(wanted, convert(wanted, args))
    opening: list[str] = []
    subsystem = Subsystem(
        path,
        domain=place.domain,
        connect=place.connect,
        libraries=place.libraries,
        kind=command.replace(" ", "-"),
        watch=not call.changes,
        take_over=place.take_over,
        partly=not call.judged,
        warned=opening.append,
    )
    opened = session.client(place.domain, connect=place.connect)
    if call.changes and not place.take_over:
        reply = _ask_master(opened, place, subsystem.files, command, args)
        if reply is not None:
            return reply
    try:
        subsystem.open(opened, once=True, task=call.task)
        reply = Desk(subsystem).perform(call)
    except PbonetError as error:
        for warning in dict.fromkeys(opening):
            error.add_note(warning)
        raise
    finally:
        subsystem.detach()
    warnings = list(dict.fromkeys([*opening, *reply.warnings]))
    return Reply(command=reply.command, data=reply.data, warnings=warnings)


def _must_be_known(client: rpc.Client, rtpus: Sequence[str], name: str) -> None:
    """Refuse a name that no RTPU knows: it may be a typing error, and nothing stopped.

    Raises:
        NodeError: No RTPU knows such a subsystem, and some know others.
    """
    infos, _ = client.call_all({rtpu: m.Hello() for rtpu in rtpus}, m.AgentInfo)
    known = {subsystem for info in infos.values() for subsystem in info.claims}
    if known and name not in known:
        raise NodeError(
            f"no RTPU knows a subsystem {name}, so nothing was stopped",
            got="subsystems: " + ", ".join(sorted(known)),
            remedy=did_you_mean(name, known) or "'pbonet stop' stops them all",
        )


def _ask_master(
    opened: zenoh.Session,
    place: Place,
    files: Files,
    command: str,
    args: Mapping[str, object],
) -> Reply | None:
    """Have a living master carry it out; None when none serves the subsystem's port.

    The session is closed but when there is none.
    """
    name = files.sbs.subsystem
    if files.job is not None and args.get("job", "") is None:
        # The master has a job of its own.
        args = {**args, "job": str(Path(files.job.file).resolve())}
    client = rpc.Client(opened, place.domain, client_name(command.replace(" ", "-")))
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
        UnreachableError: Nobody serves the port, or it has gone.
        NoAnswerError: The master does not answer.
        PbonetError: The command failed; the error is of the class the master says.
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
        if not client.tokens(key) or time.monotonic() > deadline:
            raise UnreachableError(
                "the master has gone",
                where=key,
                remedy="give the command again: it needs no other master then",
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


def subsystem_name(text: str) -> str:
    """Return the subsystem that a verb's argument means: a name, or a file's.

    Raises:
        ConfigError: It is a file, and wrong.
    """
    if Path(text).suffix in {".sbs", ".job"}:
        return Files(text, Library()).sbs.subsystem
    return text


def stop(
    name: str | None,
    *,
    domain: str,
    connect: Sequence[str] = (),
    timeout: float = 2.0,
) -> dict[str, Any]:
    """Stop a subsystem, or all, on every RTPU of a domain; no claim is needed.

    Args:
        name: The subsystem's name; None means every subsystem.
        domain: The domain.
        connect: Endpoints of agents on other machines.
        timeout: Seconds that each RTPU gives its tasks.

    Returns:
        What went off, what was ended by force, and which RTPUs were asked.

    Raises:
        UnreachableError: No agent can be reached.
        NodeError: No RTPU knows the subsystem.
        SeveralError: An RTPU did not confirm; the others were stopped.
    """
    client = rpc.Client(
        session.client(domain, connect=connect), domain, client_name("stop")
    )
    try:
        # An agent of this machine that is not heard must be said not to have stopped.
        rtpus = sorted({*client.rtpus(), *run_folder.live_agents(domain)})
        requests: dict[str, m.Request] = {
            rtpu: m.Stop(subsystem=name or "", timeout=timeout) for rtpu in rtpus
        }
        results, errors = client.call_all(
            requests, m.Stopped, timeout=timeout + rpc.ANSWER_TIME
        )
        nothing = not any(one.off or one.killed for one in results.values())
        if name is not None and nothing:
            _must_be_known(client, rtpus, name)
    except zenoh.ZError as error:
        raise rpc.no_session(error) from None
    finally:
        client.close()
    stopped = m.Stopped(
        off=[task for one in results.values() for task in one.off],
        killed=[task for one in results.values() for task in one.killed],
    )
    must_be_stopped(stopped, errors)
    return {**msgspec.to_builtins(stopped), "rtpus": rtpus}
