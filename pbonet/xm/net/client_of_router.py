"""Agents as clients of a router, instead of routers that are linked with each other.

An agent that is a router keeps the state of all others. A client asks its router for
what it needs, so that neither its memory nor its work grows with the number of
machines. It is a client of one router at a time, and of the next one named when that
is lost.

Of the agents of one machine only one has a link to a router: each is a client of one
that was there before, of which it knows by the runtime folder, and accepts those that
came later. Each has a *rank*, greater than those of all agents that it finds. As an
agent links only to lesser ranks, and accepts only greater ones, there is no circle,
whichever of them end and start again. Without a router they still see each other.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pbonet.errors import NodeError

from . import run_folder, session

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import zenoh

MESH = 8
"""Machines that agents may link with each other without a router: each of them works
for all."""


def rank_of(domain: str, name: str, *, routed: bool) -> int:
    """Return the rank of an agent that starts; 0: it is not to be a client.

    It is greater than those of the machine's other agents. An agent without routers
    is a client too where those are.

    Args:
        domain: The agent's domain.
        name: The agent.
        routed: Whether it has routers.

    Raises:
        NodeError: It has routers, and agents of the machine are no clients.
    """
    others = run_folder.ranks(domain)
    others.pop(name, None)
    lacking = sorted(one for one, rank in others.items() if not rank)
    if routed and lacking:
        raise NodeError(
            "an agent with routers cannot join agents that have none",
            where=f"domain {domain}",
            expected="routers for all agents of this machine",
            got=f"none for {', '.join(lacking)}",
            remedy="give them `routers` in agent.toml, --router or PBONET_ROUTER, too, "
            "and restart them first",
        )
    greatest = max(others.values(), default=0)
    return greatest + 1 if routed or greatest else 0


def take_place(
    places: run_folder.Places, text: str, *, routed: bool, patience: float = 0.0
) -> tuple[run_folder.NameLock, int]:
    """Take an agent's name on this machine, and its rank; return both.

    Agents that start at one time, as they do with a machine, do it one after the other:
    none finds another one whose rank is not known yet, and no two have the same.

    Args:
        places: The agent's files.
        text: Description of the agent, for the error of a second one.
        routed: Whether it has routers.
        patience: Seconds to wait for the end of the one that has the name.

    Raises:
        DuplicateNameError: Another process has the name.
        NodeError: As for `rank_of`.
    """
    with run_folder.turn(places.domain):
        rank = rank_of(places.domain, places.name, routed=routed)
        if rank:
            text += f", rank {rank}"
        return run_folder.NameLock(places.lock, text, patience=patience), rank


def open_session(
    places: run_folder.Places,
    routers: Sequence[str],
    *,
    rank: int,
    listen: Sequence[str] = (),
    key_folder: Path | None = None,
) -> zenoh.Session:
    """Open an agent's session as a client.

    Args:
        places: The agent's files.
        routers: Endpoints of routers, the nearest first.
        rank: The agent's.
        listen: Endpoints for masters and tools, besides its socket.
        key_folder: The agent's keys, if any.

    Raises:
        NodeError: An endpoint cannot be used.
        ConfigFileError: The key folder cannot be used.
    """
    named = [session.check_dialled(one, key_folder=key_folder) for one in routers]
    places.remove(*places.agents_files)  # of a killed agent; we hold the lock
    before = sorted(
        (its, name)
        for name, its in run_folder.ranks(places.domain).items()
        if 0 < its < rank and name != places.name
    )
    hubs = [run_folder.Places(places.domain, name).hub(its) for its, name in before]
    return session.routed_agent(
        places,
        [*(f"unixsock-stream/{hub}" for hub in hubs), *named],
        rank=rank,
        listen=listen,
        key_folder=key_folder,
    )


def goes_by_neighbour(link: zenoh.Session) -> bool:
    """Return whether an agent is now a client of another agent of its machine."""
    hub = re.compile(r"unixsock-stream/.+\.hub[1-9]\d*")
    return any(hub.fullmatch(str(one.dst)) for one in link.info.links())


__all__ = ["MESH", "goes_by_neighbour", "open_session", "rank_of", "take_place"]
