"""Decides an agent's duty for a link from its users, here and elsewhere.

Pure: `subsystem_links` collects the facts, calls this, and acts. A link has at most one
writer and one reader in the domain. If both are on one machine, there is nothing to do.
Otherwise the agent of the reader's machine declares a *sink*, an agent of the writer's
machine answers with a *source* that names the sink it serves, and records are sent
while both exist.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Set as AbstractSet


class LocalUsers(Struct, frozen=True):
    """Users of a link on this machine, not counting agents."""

    writer: bool
    reader: bool


class RemoteUsers(Struct):
    """Users of a link on other machines, as declared by their agents."""

    sinks: set[str] = set()
    """Agents whose machine has the reader."""
    sources: set[tuple[str, str]] = set()
    """Agents whose machine has the writer, each with the sink that it serves."""


class LinkDuty(Struct, frozen=True):
    """An agent's duty for a link."""

    sink: bool = False
    """Declare that the reader is here."""
    serve: str = ""
    """Send records to the machine of this agent."""
    take: str = ""
    """Receive records from the machine of this agent."""


IDLE = LinkDuty()


def duty(me: str, here: LocalUsers, there: RemoteUsers, now: LinkDuty) -> LinkDuty:
    """Return the duty of the agent `me` for a link, given its current duty `now`."""
    if here.writer and not here.reader:
        return LinkDuty(serve=_keep(now.serve, there.sinks - {me}))
    if here.reader and not here.writer:
        serving = {agent for agent, sink in there.sources if sink == me}
        return LinkDuty(sink=True, take=_keep(now.take, serving - {me}))
    return IDLE


def _keep(now: str, able: AbstractSet[str]) -> str:
    """Return `now` if it is possible, else the first possible one in the alphabet."""
    return now if now in able else min(able, default="")
