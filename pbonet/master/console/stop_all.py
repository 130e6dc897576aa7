"""Stop subsystems on every RTPU of a domain: ``pbonet stop``."""

from __future__ import annotations

import secrets
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import zenoh

from pbonet.config import Library
from pbonet.errors import NodeError, UnreachableError, did_you_mean
from pbonet.master.configuration import Files, all_stopped, must_be_stopped
from pbonet.master.subsystem import client_name
from pbonet.xm.net import messages as m, rpc, run_folder, session, unreachable_reason

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence


def subsystem_name(text: str) -> str:
    """Return the subsystem that a verb's argument means: a name, or a file's.

    Raises:
        ConfigError: It is a file, and wrong.
    """
    if Path(text).suffix in {".sbs", ".job", ".seq"}:
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
        Tasks turned off, tasks terminated by force, and the RTPUs asked.

    Raises:
        UnreachableError: No agent can be reached.
        NodeError: No RTPU knows the subsystem.
        SeveralError: A task failed as it ended; or an RTPU did not confirm, or had the
            subsystem and is not seen now. The others were stopped, and repeat the stop
            there.
    """
    client = rpc.Client(
        session.client(domain, connect=connect), domain, client_name("stop")
    )
    try:
        # An agent of this machine that does not answer counts as not stopped.
        rtpus = sorted({*client.rtpus(), *run_folder.live_agents(domain)})
        order = m.Stop(
            subsystem=name or "", timeout=timeout, stop_id=secrets.token_hex(8)
        )
        requests: dict[str, m.Request] = {rtpu: copy(order) for rtpu in rtpus}
        results, errors = client.call_all(
            requests, m.Stopped, timeout=timeout + rpc.ANSWER_TIME
        )
        nothing = not any(one.off or one.killed for one in results.values())
        infos, _ = client.call_all({rtpu: m.Hello() for rtpu in results}, m.AgentInfo)
        unseen = _unseen(infos.values(), name, stopped=results)
        if name is not None and nothing and not unseen:
            _must_be_known(infos.values(), name)
    except zenoh.ZError as error:
        raise rpc.no_session(error) from None
    finally:
        client.close()
    stopped = all_stopped(results.values())
    errors += [
        _not_seen(by, lost)
        for rtpu, (by, lost) in unseen.items()
        if rtpu not in requests  # else its own error is among them
    ]
    unsure = {rtpu: _on(lost, name) for rtpu, (_, lost) in unseen.items()}
    must_be_stopped(stopped, errors, unsure)
    return {**msgspec.to_builtins(stopped), "rtpus": rtpus}


def _unseen(
    infos: Collection[m.AgentInfo], name: str | None, *, stopped: Collection[str]
) -> dict[str, tuple[m.AgentInfo, m.Lost]]:
    """Return RTPUs that had the subsystem and are not seen, with who saw them last."""
    found: dict[str, tuple[m.AgentInfo, m.Lost]] = {}
    seen = {*stopped, *(info.name for info in infos)}
    for info in infos:
        for lost in info.lost:
            concerned = lost.on if name is None else name in lost.on
            if not concerned or lost.rtpu in seen:
                continue
            last = found.setdefault(lost.rtpu, (info, lost))
            if lost.ago < last[1].ago:
                found[lost.rtpu] = info, lost
    return found


def _on(lost: m.Lost, name: str | None) -> list[str]:
    """Return the tasks that were ON when an RTPU was last seen."""
    chosen = lost.on.values() if name is None else [lost.on.get(name, [])]
    return [task for tasks in chosen for task in tasks]


def _not_seen(by: m.AgentInfo, lost: m.Lost) -> UnreachableError:
    return UnreachableError(
        "the agent cannot be reached",
        where=lost.rtpu,
        got=unreachable_reason.loss(by, lost),
        remedy=unreachable_reason.remedy(by, lost),
    )


def _must_be_known(infos: Iterable[m.AgentInfo], name: str) -> None:
    """Refuse a name that no RTPU knows: it may be a typing error, and nothing stopped.

    Raises:
        NodeError: No RTPU knows such a subsystem, and some know others.
    """
    known = {subsystem for info in infos for subsystem in info.claims}
    if known and name not in known:
        raise NodeError(
            f"no RTPU knows a subsystem {name}, so nothing was stopped",
            got="subsystems: " + ", ".join(sorted(known)),
            remedy=did_you_mean(name, known) or "'pbonet stop' stops them all",
        )
