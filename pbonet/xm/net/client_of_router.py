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

On a machine whose agents have no routers, the first few are routers for the others,
each at a *place*, which is a socket of its own. An agent that takes a place that has
become free is found there, by the clients and by the other routers. An agent that is
reached from other machines, or reaches them, is always a router.
"""

from __future__ import annotations

import contextlib
import re
import time
from typing import TYPE_CHECKING

import zenoh

from pbonet.errors import NodeError

from . import run_folder, session
from .run_folder import Position

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

MESH = 8
"""Machines that agents may link with each other without a router: each of them works
for all."""
HERE = 4
"""Agents of one machine without routers that are linked each with each. Further ones
are their clients."""
PLACES = 8
"""Where the agents of a machine that are routers are found by the others: the first
few, and those that other machines reach."""
NEIGHBOUR_TIME = 1.0
"""Seconds for which a client counts on having the same link."""
_NEIGHBOUR = re.compile(
    r"unixsock-stream/.+/(\.router(?P<place>\d+)|(?P<name>[^/]+)\.hub[1-9]\d*)"
)


def position_of(
    domain: str, name: str, *, routed: bool, reached: bool = False
) -> Position:
    """Return what an agent that starts is to be among those of its machine.

    Its rank is greater than those of the others. An agent without routers is a client
    too where those are, or where there are `HERE` routers, unless others reach it.

    Args:
        domain: The agent's domain.
        name: The agent.
        routed: Whether it has routers.
        reached: Whether it has links of its own to other machines.

    Raises:
        NodeError: It has routers, and agents of the machine have none.
    """
    others = run_folder.positions(domain)
    others.pop(name, None)
    lacking = sorted(
        one for one, its in others.items() if not its.rank or its.place is not None
    )
    if routed and lacking:
        raise NodeError(
            "an agent with routers cannot join agents that have none",
            where=f"domain {domain}",
            expected="routers for all agents of this machine",
            got=f"none for {', '.join(lacking)}",
            remedy="give them `routers` in agent.toml, --router or PBONET_ROUTER, too, "
            "and restart them first",
        )
    rank = max((its.rank for its in others.values()), default=0) + 1
    if len(lacking) < len(others) or routed:
        return Position(rank)
    taken = {its.place for its in others.values() if not its.rank}
    routers = sum(not its.rank for its in others.values())
    if routers >= HERE and not reached:
        return Position(rank, 0)
    free = (place for place in range(1, PLACES + 1) if place not in taken)
    return Position(0, next(free, 0))


def take_place(
    places: run_folder.Places,
    text: str,
    *,
    routed: bool,
    reached: bool = False,
    patience: float = 0.0,
) -> tuple[run_folder.NameLock, Position]:
    """Take an agent's name on this machine, and its position; return both.

    Agents that start at one time, as they do with a machine, do it one after the other:
    none finds another one whose rank is not known yet, and no two have the same.

    Args:
        places: The agent's files.
        text: Description of the agent, for the error of a second one.
        routed: Whether it has routers.
        reached: Whether it has links of its own to other machines.
        patience: Seconds to wait for the end of the one that has the name.

    Raises:
        DuplicateNameError: Another process has the name.
        NodeError: As for `position_of`.
    """
    with run_folder.turn(places.domain):
        position = position_of(
            places.domain, places.name, routed=routed, reached=reached
        )
        lock = run_folder.NameLock(places.lock, f"{text}{position}", patience=patience)
        return lock, position


def open_session(
    places: run_folder.Places,
    routers: Sequence[str],
    *,
    position: Position,
    listen: Sequence[str] = (),
    key_folder: Path | None = None,
) -> zenoh.Session:
    """Open an agent's session as a client.

    Args:
        places: The agent's files.
        routers: Endpoints of routers, the nearest first; none for an agent that is a
            client of the machine's own.
        position: The agent's.
        listen: Endpoints for masters and tools, besides its socket.
        key_folder: The agent's keys, if any.

    Raises:
        NodeError: An endpoint cannot be used.
        ConfigFileError: The key folder cannot be used.
    """
    named = [session.check_dialled(one, key_folder=key_folder) for one in routers]
    places.remove(*places.agents_files)  # of a killed agent; we hold the lock
    rank, place = position
    before = sorted(
        (its.rank, name)
        for name, its in run_folder.positions(places.domain).items()
        if 0 < its.rank < rank and name != places.name
    )
    hubs = [run_folder.Places(places.domain, name).hub(its) for its, name in before]
    north = [f"unixsock-stream/{hub}" for hub in hubs]
    north = [*north, *named] if place is None else [*_of_machine(places, rank), *north]
    return session.routed_agent(
        places, north, rank=rank, listen=listen, key_folder=key_folder
    )


def _of_machine(places: run_folder.Places, rank: int) -> list[str]:
    """Return the sockets of the machine's routers; the first few share the ranks."""
    order = [(rank + number) % HERE + 1 for number in range(HERE)]
    order += range(HERE + 1, PLACES + 1)
    return [places.router_endpoint(place) for place in order]


def goes_by_neighbour(link: zenoh.Session) -> bool:
    """Return whether an agent is now a client of another agent of its machine."""
    return any(_NEIGHBOUR.fullmatch(str(one.dst)) for one in link.info.links())


class Neighbour:
    """Finds the agent of the machine of which another one is now a client.

    While that one is stopped, nothing passes: its clients would be lost to all others.

    Args:
        link: The session of the client.
        domain: Its domain.
    """

    def __init__(self, link: zenoh.Session, domain: str) -> None:
        self._link, self._domain = link, domain
        self._links: set[tuple[str, str]] = set()
        """Where each one leads, and the identity of what is there."""
        self._found: dict[int, str] = {}
        self._next = 0.0

    def processes(self) -> dict[int, str]:
        """Return its process with what it is, as found within `NEIGHBOUR_TIME`."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + NEIGHBOUR_TIME
            # The runtime folder may be removed, or not be the user's own any more.
            with contextlib.suppress(zenoh.ZError, OSError, NodeError):
                self._follow_links()
        return self._found

    def _follow_links(self) -> None:
        links = {(str(one.dst), str(one.zid)) for one in self._link.info.links()}
        if links != self._links or not self._found:  # to read all locks takes longer
            self._links, self._found = links, self._find(links)

    def _find(self, links: set[tuple[str, str]]) -> dict[int, str]:
        ends = [_NEIGHBOUR.fullmatch(where) for where, _ in links]
        names = {self._name_of(end) for end in ends if end is not None}
        processes = run_folder.agent_processes(self._domain) if names else {}
        return {
            pid: f"agent {name}, by which this one is linked with others,"
            for name, pid in processes.items()
            if name in names and pid
        }

    def _name_of(self, end: re.Match[str]) -> str:
        if end["name"]:
            return end["name"]
        found = Position(0, int(end["place"]))
        all_here = run_folder.positions(self._domain).items()
        return next((name for name, its in all_here if its == found), "")


__all__ = [
    "MESH",
    "Neighbour",
    "goes_by_neighbour",
    "open_session",
    "position_of",
    "take_place",
]
