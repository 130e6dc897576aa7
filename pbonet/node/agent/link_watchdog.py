"""Cuts links that are up but transfer no declarations, so that they are opened again.

A zenoh router sends a neighbour its declarations when the neighbour becomes a child in
its tree of links. Trees are computed at most every 100 ms and compared with the last
ones. So a neighbour whose link closes and reopens within that time receives none: it
sees no token and no request can be routed to it, as long as the link lasts. This
happens if a router with several links was delayed for a moment (decision 0194).

zenoh cannot close a single link. Shutting down its socket has the same effect as
pulling a cable: both routers notice at once, and the dialling side dials again. A
client dials the endpoints of its list, and so comes back to the first router of it.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import socket
import stat
import struct
import threading
from typing import TYPE_CHECKING, NamedTuple

import zenoh

from pbonet.xm.net import access_control

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from pbonet.xm.net import AgentInfo

log = logging.getLogger("pbonet.node")

LOOKS = 3
"""Number of checks, one second apart, after which an unseen neighbour is cut off."""
PAUSE = 10
"""Number of checks until the same link may be cut again."""
MOST = 256
"""Maximum number of remembered neighbours; each start of an agent counts as one."""
NEAREST_LOOK = 10.0
"""Seconds between checks whether a router is back that the agent prefers."""
STEADY = 3
"""How many of these checks it must have answered, one after the other."""
AWAY = 60
"""How many are left out after a change: zenoh may have taken another one."""
ANSWER_TIME = 0.5
"""Seconds in which a router must accept a connection."""
_CREDENTIALS = struct.Struct("3i")


class Neighbour(NamedTuple):
    """An agent of the domain that has answered."""

    name: str
    pid: int
    here: bool
    """Whether it is on this machine."""


class LinkWatchdog:
    """An agent's knowledge of its neighbours.

    Args:
        session: The agent's session.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._known: dict[str, Neighbour] = {}
        """By zenoh identity."""
        self._missed: dict[str, int] = {}
        """Number of checks in which a neighbour was not seen; negative: a pause."""

    def met(self, info: AgentInfo, *, here: bool) -> bool:
        """Store the identity of an agent that has answered; return if it is near."""
        self._known.pop(info.zid, None)
        self._known[info.zid] = Neighbour(info.name, info.pid, here)
        while len(self._known) > MOST:
            self._known.pop(next(iter(self._known)))
        return info.zid in self._linked()

    def unknown(self) -> bool:
        """Return whether there is a link to an agent that has never answered."""
        return not self._linked() <= self._known.keys()

    def _linked(self) -> set[str]:
        return {str(zid) for zid in self._session.info.routers_zid()}

    def unseen(self, seen: Iterable[str]) -> dict[str, Neighbour]:
        """Return the neighbours that have a link but are not seen."""
        there = set(seen)
        return {
            zid: known
            for zid in self._linked()
            if (known := self._known.get(zid)) and known.name not in there
        }

    def cut_silent(self, seen: Iterable[str]) -> list[str]:
        """Cut links that transfer no declarations; to be called every second.

        Args:
            seen: Names of the agents that are seen and can be asked.

        Returns:
            The neighbours to which a link was cut.
        """
        unseen = self.unseen(seen)
        missed = {
            zid: count + 1
            for zid, count in self._missed.items()
            if zid in unseen or count < 0  # pauses continue
        }
        self._missed = dict.fromkeys(unseen, 1) | missed
        again: list[str] = []
        for zid, known in unseen.items():
            if self._missed[zid] >= LOOKS:
                self._missed[zid] = -PAUSE
                if self._cut(zid, known):
                    again.append(known.name)
        return again

    def _cut(self, zid: str, known: Neighbour) -> bool:
        """Shut down the sockets of a neighbour's links; return whether it had any."""
        links = [one for one in self._session.info.links() if str(one.zid) == zid]
        return _cut(links, known)


def cut_tls(session: zenoh.Session) -> bool:
    """Cut a session's links over TLS; return whether there were any."""
    with contextlib.suppress(zenoh.ZError):  # it is being closed
        links = session.info.links()
        return _cut(one for one in links if str(one.src).startswith("tls/"))
    return False


class NearestRouter:
    """Takes an agent that is a client back to a router that it prefers.

    It is done while no agent, master or program depends on the link: all tokens of the
    agent are gone for some milliseconds then, and a table would lose its machine.

    Args:
        session: The agent's session.
        routers: Endpoints of the routers, the nearest first.
        needed: Returns whether one of these depends on the link.
        name: The agent.
    """

    def __init__(
        self,
        session: zenoh.Session,
        routers: Sequence[str],
        needed: Callable[[], bool],
        name: str = "",
    ) -> None:
        self._session, self._routers = session, list(routers)
        self._needed, self._name = needed, name
        self._answered = 0
        """In how many checks a nearer one has answered; negative: a pause."""
        self._over = threading.Event()
        self._thread = threading.Thread(
            target=self._watch, name="pbonet nearest", daemon=True
        )

    def start(self) -> None:
        """Start to check, if there is more than one router."""
        if len(self._routers) > 1:
            self._thread.start()

    def stop(self) -> None:
        """End that; a name that is being resolved is not waited for."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(ANSWER_TIME)

    def _watch(self) -> None:
        while not self._over.wait(NEAREST_LOOK):
            with contextlib.suppress(zenoh.ZError, OSError):
                self.check()

    def check(self) -> bool:
        """Cut the link if a nearer router is there for a while; return whether so."""
        links = self._session.info.links()
        if self._answered < 0:
            self._answered += 1
            return False
        there = len(links) == 1 and not self._needed() and self._has_nearer(links[0])
        self._answered = self._answered + 1 if there else 0
        if self._answered < STEADY:
            return False
        if self._over.is_set() or self._needed():  # since the router was asked
            return False
        self._answered = -AWAY
        has_cut = _cut(links)
        if has_cut:
            log.info("%s: back to a nearer router, which answers again", self._name)
        return has_cut

    def _has_nearer(self, link: zenoh.Link) -> bool:
        """Return whether one that comes before the router of a link answers."""
        used = plain(str(link.dst))
        for number, endpoint in enumerate(self._routers):
            if used in resolved(endpoint):
                return any(map(_answers, self._routers[:number]))
        return False  # the link leads to another agent of this machine


def _answers(endpoint: str) -> bool:
    """Return whether connections to a network endpoint are accepted."""
    host, _, port = inside(endpoint).rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_TIME).close()
    except (OSError, ValueError):
        return False
    return True


def _cut(links: Iterable[zenoh.Link], known: Neighbour | None = None) -> bool:
    """Shut down the sockets of links; return whether there were any.

    Args:
        links: The links.
        known: The agent at their other end, if it is one.
    """
    ends = {(plain(str(one.src)), plain(str(one.dst))) for one in links}
    return sum(_is_link(one, ends, known) and _shut(one) for one in _sockets()) > 0


def _sockets() -> Iterator[socket.socket]:
    """Yield duplicates of this process's sockets, one at a time."""
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - numbers, no paths
        with contextlib.suppress(OSError):
            copy = os.dup(int(name))
            if not stat.S_ISSOCK(os.fstat(copy).st_mode):
                os.close(copy)
                continue
            with socket.socket(fileno=copy) as one:
                yield one


def _is_link(
    one: socket.socket, ends: set[tuple[str, str]], known: Neighbour | None
) -> bool:
    """Return whether a socket carries one of the links to a neighbour."""
    if one.family not in {socket.AF_INET, socket.AF_INET6, socket.AF_UNIX}:
        return False
    try:
        near, far = one.getsockname(), one.getpeername()
        if one.family != socket.AF_UNIX:
            return (_address(near), _address(far)) in ends
        size = _CREDENTIALS.size
        found = one.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    except OSError:  # a listening socket, or already closed
        return False
    places = {end for pair in ends for end in pair}
    return (
        known is not None
        and known.here
        and _CREDENTIALS.unpack(found)[0] == known.pid
        and not places.isdisjoint({near, far})
    )


def _shut(one: socket.socket) -> bool:
    try:
        one.shutdown(socket.SHUT_RDWR)
    except OSError:  # already closed
        return False
    return True


def resolved(endpoint: str) -> set[str]:
    """Return the possible addresses of a network endpoint, in the form of `plain`."""
    host, _, port = inside(endpoint).rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port))
    except (OSError, UnicodeError):
        return set()
    return {_spelled(str(one[4][0]), port) for one in found} | {plain(endpoint)}


def inside(locator: str) -> str:
    """Return the part of a locator between its protocol and its settings."""
    return locator.partition("/")[2].partition("?")[0].partition("#")[0]


def plain(locator: str) -> str:
    """Return the address of a locator in normal form; a path is returned unchanged."""
    address = inside(locator)
    if locator.startswith(access_control.LOCAL):
        return address
    host, _, port = address.rpartition(":")
    return _spelled(host.strip("[]"), port)


def _address(found: tuple[str, int, int, int] | tuple[str, int]) -> str:
    return _spelled(found[0], str(found[1]))


def _spelled(host: str, port: str) -> str:
    try:
        ip = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return f"{host} {port}"
    if isinstance(ip, ipaddress.IPv6Address) and ip.ipv4_mapped:
        ip = ip.ipv4_mapped
    return f"{ip} {port}"
