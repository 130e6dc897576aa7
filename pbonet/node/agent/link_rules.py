"""Decides an agent's duty for a link from its users, here and elsewhere.

Pure: `subsystem_links` collects the facts, calls this, and acts. A link has at most one
writer and one reader in the domain. Where both are on one machine, nothing is to be
done. Else the agent of the reader's machine shows a *sink*, one of the writer's answers
with a *source* that names the sink it serves, and records flow while both exist.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Set as AbstractSet


class LocalUsers(Struct, frozen=True):
    """Users of a link on this machine, without agents."""

    writer: bool
    reader: bool


class RemoteUsers(Struct):
    """Users of a link on other machines, as their agents show them."""

    sinks: set[str] = set()
    """Agents whose machine has the reader."""
    sources: set[tuple[str, str]] = set()
    """Agents whose machine has the writer, and the sink that each serves."""


class LinkDuty(Struct, frozen=True):
    """An agent's duty for a link."""

    sink: bool = False
    """Show that the reader is here."""
    serve: str = ""
    """Send records to the machine of this agent."""
    take: str = ""
    """Take records from the machine of this agent."""


IDLE = LinkDuty()


def duty(me: str, here: LocalUsers, there: RemoteUsers, now: LinkDuty) -> LinkDuty:
    """Return the duty of the agent `me` for a link, given its present duty `now`."""
    if here.writer and not here.reader:
        return LinkDuty(serve=_keep(now.serve, there.sinks - {me}))
    if here.reader and not here.writer:
        serving = {agent for agent, sink in there.sources if sink == me}
        return LinkDuty(sink=True, take=_keep(now.take, serving - {me}))
    return IDLE


def _keep(now: str, able: AbstractSet[str]) -> str:
    """Return `now` as long as it is able, else the first of them in the alphabet."""
    return now if now in able else min(able, default="")
