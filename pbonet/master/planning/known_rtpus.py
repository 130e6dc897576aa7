"""Facts about a subsystem's RTPUs: their machines, and what tasks can open there.

Their agents are asked for it, or the user gives it; else each RTPU counts as a machine
of its own, and a task stays where it is if it opens something by name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.analysis.schedule import ASSUMED, CoreShare
from pbonet.errors import ConfigError, NodeError, did_you_mean
from pbonet.master.subsystem import client_name, core_shares
from pbonet.xm.net import messages as m, rpc, session

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pbonet.config import SbsFile
    from pbonet.master.configuration import Place


class KnownRtpus(Struct, frozen=True, kw_only=True):
    """Facts about the RTPUs of a subsystem."""

    machines: dict[str, str]
    """The machine of each."""
    hosts: dict[str, str] = {}
    """Its name, under which profiles are saved; empty: not known."""
    cores: dict[str, int] = {}
    """The core of each; empty: not known."""
    names: dict[str, dict[str, list[str]]] = {}
    """Names that tasks can open on each, by kind; empty: not known."""
    shares: dict[str, CoreShare] = {}
    """The share of each one's core for tasks; empty: not known."""
    asked: bool = False
    """Agents reported it."""


def as_stated(sbs: SbsFile, pairs: Iterable[str]) -> KnownRtpus:
    """Return what the user says of the machines.

    Args:
        sbs: The subsystem.
        pairs: Texts ``RTPU=MACHINE``; other RTPUs are machines of their own.

    Raises:
        ConfigError: A text is malformed, or names an RTPU twice or none of them.
    """
    machines = {entry.name: entry.name for entry in sbs.rtpus}
    told: set[str] = set()
    for pair in pairs:
        rtpu, equals, machine = pair.partition("=")
        if not equals or not machine or rtpu not in machines or rtpu in told:
            raise ConfigError(
                f"--machine cannot be {pair!r}",
                where=sbs.file,
                expected=f"RTPU=MACHINE, once for one of {', '.join(machines)}",
                remedy=did_you_mean(rtpu, machines) or "such as arm0=host1",
            )
        machines[rtpu] = machine
        told.add(rtpu)
    return KnownRtpus(machines=machines)


def ask_agents(sbs: SbsFile, place: Place) -> KnownRtpus:
    """Return what the agents of the subsystem's RTPUs tell.

    Raises:
        UnreachableError: No agent can be reached.
        NodeError: An RTPU has no agent, or it does not answer.
    """
    opened = session.client(place.domain, connect=place.connect)
    client = rpc.Client(opened, place.domain, client_name("allocate"))
    try:
        there = set(client.rtpus())
        wanted = [entry.name for entry in sbs.rtpus]
        _must_be_there(wanted, there, place.domain)
        infos, errors = client.call_all({one: m.Hello() for one in wanted}, m.AgentInfo)
    finally:
        client.close()
    rpc.raise_all("the RTPUs did not all describe themselves", errors)
    return KnownRtpus(
        machines={name: info.machine for name, info in infos.items()},
        hosts={name: info.host for name, info in infos.items()},
        cores={name: info.core for name, info in infos.items()},
        shares=core_shares(infos),
        names={
            name: {kind: list(names) for kind, names in info.names.items()}
            for name, info in infos.items()
        },
        asked=True,
    )


def cores_of(known: KnownRtpus, limit: float | None) -> dict[str, CoreShare]:
    """Return what tasks may use of each core, as the RTPUs themselves rank by it.

    Args:
        known: What is known of the RTPUs.
        limit: The share that the user allows; of a core whose agent was asked it can
            only take something away.
    """
    found: dict[str, CoreShare] = {}
    for rtpu in known.machines:
        core = known.shares.get(rtpu, ASSUMED)
        if limit is not None and (rtpu not in known.shares or limit < core.share):
            core = structs.replace(core, share=limit, reason="--limit")
        found[rtpu] = core
    return found


def _must_be_there(wanted: Sequence[str], there: set[str], domain: str) -> None:
    missing = [name for name in wanted if name not in there]
    if missing:
        raise NodeError(
            f"{' and '.join(missing)} have no agent"
            if len(missing) > 1
            else f"{missing[0]} has no agent",
            where=f"domain {domain}",
            expected="an agent for each RTPU of the subsystem",
            got=", ".join(sorted(there)) or "none",
            remedy="start it, or leave --running out and say with --machine which "
            "RTPUs share a machine",
        )


def readable(machines: Mapping[str, str], hosts: Mapping[str, str]) -> dict[str, str]:
    """Return the name of each RTPU's machine for people."""
    return {rtpu: hosts.get(rtpu) or machine for rtpu, machine in machines.items()}
