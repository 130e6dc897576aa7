"""Decides which of two agents dials the other, so that exactly one does.

When two agents dial each other zenoh opens two links, and its routers then stall for
seconds and send in circles whenever a third link comes or goes (decision 0085). So
before an agent dials, it asks whether the other one already dials it. Two that start at
the same time could not ask each other; therefore each publishes what it dials as soon
as its session is open, and asks again after that. One of the two then withdraws: the
later question always sees what the other agent has published.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import zenoh

from pbonet.errors import PbonetError

from . import codec, key_expressions, run_folder, session
from .callbacks import direct

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

ASK_TIME = 0.5
"""Seconds in which the agent at an endpoint reports what it dials."""
SETTLE_TIME = 3.0
"""Seconds to wait for an agent that must withdraw; it may also do so later."""
LINK_TIME = 0.3
"""Seconds for the links to existing agents to open, before names are checked."""
PAUSE = 0.02


class Dials(msgspec.Struct, kw_only=True):
    """An agent's report while it decides which agents to dial."""

    rtpu: str
    zid: str
    dials: list[str]
    settled: bool
    """Whether the decision is final."""


_DIALS: Final = msgspec.msgpack.Decoder(Dials)


class DialledAgent(NamedTuple):
    """The agent found at an endpoint."""

    zid: str = ""
    """The zenoh identity of the router there; empty if there is none."""
    said: Dials | None = None
    """Its report, if it is a running agent of the domain."""


class Dialled:
    """An agent's session, and the endpoints it dials.

    Args:
        places: The agent's files.
        listen: Endpoints that it listens on, besides its socket.
        connect: Endpoints to which it needs a link, whichever side dials.
        multicast: See `session.agent`.
        key_folder: The agent's keys, if any.
        place: At which it is a router for the others of the machine, if at any.

    Raises:
        NodeError: An endpoint cannot be listened on.
    """

    def __init__(
        self,
        places: run_folder.Places,
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        multicast: bool = False,
        key_folder: Path | None = None,
        place: int | None = None,
    ) -> None:
        self._places, self._multicast = places, multicast
        self._router = places.router(place) if place else None
        self._listen = [*listen, places.router_endpoint(place)] if place else listen
        self._key_folder = key_folder
        self._mine = [places.endpoint, *self._listen]
        self._settled = False
        named = [session.check_dialled(e, key_folder=key_folder) for e in connect]
        wanted = list(dict.fromkeys([*named, *neighbours(places)]))
        found = self._find_agents(wanted)
        mutual = {e for e, behind in found.items() if self._dials_me(behind)}
        vain = mutual | _doubled(found)
        self.dials: list[str] = [one for one in wanted if one not in vain]
        self.session = self._open()

    def settle(self) -> None:
        """Withdraw from endpoints whose agent dials too; to be called before others.

        Raises:
            NodeError: The session cannot be opened again.
        """
        begin = time.monotonic()
        while self.dials:
            found = self._find_agents(self.dials)
            passed = time.monotonic() - begin
            back = self._vain(found)
            if back:
                self.dials = [one for one in self.dials if one not in back]
                self.session.close()  # type: ignore[no-untyped-call]
                self.session = self._open()
            elif passed < SETTLE_TIME and self._open_question(
                found, silent=passed < ASK_TIME
            ):
                time.sleep(PAUSE)
            else:
                self._wait_links({behind.zid for behind in found.values()})
                break
        self._settled = True

    # -- which agent withdraws ---------------------------------------------------------

    def _vain(self, found: Mapping[str, DialledAgent]) -> set[str]:
        """Return the endpoints that must not be dialled."""
        back = _doubled(found)
        me = self._places.name, str(self.session.info.zid())
        for endpoint, behind in found.items():
            said = behind.said
            if behind.zid == me[1]:
                back.add(endpoint)
            elif said is None or not self._dials_me(behind):
                continue
            elif said.settled or me > (said.rtpu, said.zid):
                back.add(endpoint)
        return back

    def _open_question(
        self, found: Mapping[str, DialledAgent], *, silent: bool
    ) -> bool:
        """Return whether an agent must be asked again.

        Args:
            found: The agent at each endpoint.
            silent: Whether a router without a report may still be an agent.
        """
        return any(
            (zid and silent) if said is None else self._dials_me(found[endpoint])
            for endpoint, (zid, said) in found.items()
        )

    def _dials_me(self, behind: DialledAgent) -> bool:
        said = behind.said
        return said is not None and any(is_mine(one, self._mine) for one in said.dials)

    # -- sessions ----------------------------------------------------------------------

    def _open(self) -> zenoh.Session:
        """Open the session, and publish at once what is dialled."""
        self._places.remove(self._places.sock)  # of a killed agent; we hold the lock
        if self._router is not None:
            self._places.remove(self._router)  # likewise
        link = session.agent(
            self._places,
            listen=self._listen,
            dial=self.dials,
            multicast=self._multicast,
            key_folder=self._key_folder,
        )
        said = Dials(
            rtpu=self._places.name,
            zid=str(link.info.zid()),
            dials=self.dials,
            settled=False,
        )

        key = key_expressions.rtpu(self._places.domain, self._places.name, "dials")

        def answer(query: zenoh.Query) -> None:
            said.settled = self._settled
            with contextlib.suppress(zenoh.ZError):
                query.reply(key, msgspec.msgpack.encode(said))  # pyright: ignore[reportUnknownMemberType]

        self._queryable = link.declare_queryable(key, direct(answer))
        return link

    def _wait_links(self, routers: set[str]) -> None:
        """Wait until the links to the agents that were found are open."""
        deadline = time.monotonic() + LINK_TIME
        missing = routers - {""}
        while missing and time.monotonic() < deadline:
            time.sleep(PAUSE)
            missing -= {str(zid) for zid in self.session.info.routers_zid()}

    def _find_agents(self, endpoints: Sequence[str]) -> dict[str, DialledAgent]:
        """Return the agent now found at each endpoint."""
        if not endpoints:
            return {}
        with ThreadPoolExecutor(len(endpoints)) as pool:
            return dict(zip(endpoints, pool.map(self._behind, endpoints), strict=True))

    def _behind(self, endpoint: str) -> DialledAgent:
        try:
            link = session.client(
                self._places.domain,
                connect=[endpoint],
                timeout=0.0,
                local=False,
                key_folder=self._key_folder,
            )
        except PbonetError:
            return DialledAgent()
        try:
            return _ask(link, self._places.domain)
        finally:
            link.close()  # type: ignore[no-untyped-call]


def _ask(link: zenoh.Session, domain: str) -> DialledAgent:
    """Return the agent that a client is connected to."""
    near = str(next(iter(link.info.routers_zid()), ""))
    replies = link.get(
        key_expressions.all_rtpus(domain, "dials"),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=ASK_TIME,
    )
    for reply in replies:
        if reply.ok is None:
            continue
        with contextlib.suppress(*codec.MALFORMED):
            said = _DIALS.decode(reply.ok.payload.to_bytes())
            if said.zid == near:
                return DialledAgent(near, said)
    return DialledAgent(near)


def _doubled(found: Mapping[str, DialledAgent]) -> set[str]:
    """Return the endpoints whose agent is also dialled at an earlier endpoint."""
    seen: set[str] = set()
    double: set[str] = set()
    for endpoint, behind in found.items():
        if behind.zid in seen:
            double.add(endpoint)
        elif behind.zid:
            seen.add(behind.zid)
    return double


def neighbours(places: run_folder.Places) -> list[str]:
    """Return the sockets of the other routers among the machine's agents."""
    with run_folder.turn(places.domain):  # so that each has said what it is
        found = sorted(run_folder.positions(places.domain).items())
    return [
        run_folder.Places(places.domain, name).router_endpoint(its.place)
        for name, its in found
        if name != places.name and not its.rank
    ]


def links(link: zenoh.Session) -> Counter[str]:
    """Return the number of links to each router, by its zenoh identity."""
    routers = {str(zid) for zid in link.info.routers_zid()}
    return Counter(zid for one in link.info.links() if (zid := str(one.zid)) in routers)


def _address(endpoint: str) -> str:
    return endpoint.partition("?")[0].partition("#")[0]


def is_mine(endpoint: str, listens: Iterable[str]) -> bool:
    """Return whether this agent listens on an endpoint that another one dials."""
    plain = _address(endpoint)
    for own in map(_address, listens):
        if plain == own:
            return True
        protocol, _, address = plain.partition("/")
        own_protocol, _, own_address = own.partition("/")
        host, _, port = address.rpartition(":")
        if protocol == own_protocol and port == own_address.rpartition(":")[2]:
            return _is_here(host.strip("[]"))
    return False


def _is_here(host: str) -> bool:
    """Return whether an address belongs to this machine, by binding to it."""
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)
    except OSError:
        return False
    for family, kind, _, _, address in found:
        with contextlib.suppress(OSError), socket.socket(family, kind) as probe:
            probe.bind(address)
            return True
    return False


__all__ = ["Dialled", "is_mine", "links", "neighbours"]
