"""Stop subsystems on every RTPU of a domain: ``pbonet stop``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import zenoh

from pbonet.config import Library
from pbonet.errors import NodeError, did_you_mean
from pbonet.master.configuration import Files, must_be_stopped
from pbonet.master.subsystem import client_name
from pbonet.xm.net import messages as m, rpc, run_folder, session

if TYPE_CHECKING:
    from collections.abc import Sequence


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
        Tasks turned off, tasks terminated by force, and the RTPUs asked.

    Raises:
        UnreachableError: No agent can be reached.
        NodeError: No RTPU knows the subsystem.
        SeveralError: An RTPU did not confirm; the others were stopped.
    """
    client = rpc.Client(
        session.client(domain, connect=connect), domain, client_name("stop")
    )
    try:
        # An agent of this machine that does not answer counts as not stopped.
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
