"""Which of two agents dials the other: exactly one.

When two agents dial each other zenoh makes two links of it, and its routers then stall
for seconds and send in circles whenever a third link comes or goes (decision 0085). So
an agent asks, before it dials, whether the other one dials it already; and when both
have started at one time, so that neither could ask, one of them takes its own back.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import msgspec
import zenoh

from pbonet.errors import PbonetError

from . import codec, keys, rundir, session
from . import messages as m

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Sequence
    from pathlib import Path

ASK_TIME = 0.5
"""Seconds in which an agent behind an endpoint says who it is."""
SETTLE_TIME = 0.3
"""Seconds in which a link that is dialled at a start stands, if anybody is there."""


class Dialled:
    """An agent's session, and what it dials.

    Args:
        places: The agent's files.
        listen: Endpoints that it listens on, beside its socket.
        connect: Endpoints that it is to be linked to, whoever dials.
        multicast: See `session.agent`.
        key_folder: The agent's keys, if it has any.

    Raises:
        NodeError: An endpoint cannot be listened on.
    """

    def __init__(
        self,
        places: rundir.Places,
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        multicast: bool = False,
        key_folder: Path | None = None,
    ) -> None:
        self._places, self._listen, self._multicast = places, listen, multicast
        self._key_folder = key_folder
        named = [session.check_endpoint(e, key_folder=key_folder) for e in connect]
        wanted = [*named, *neighbours(places)]
        self.dials = self._not_dialled_by(wanted)
        self.session = self._open()

    def settle(self) -> None:
        """Take back what another agent dials too; nothing may be declared yet.

        Raises:
            NodeError: The session cannot be opened again.
        """
        if not self.dials:
            return
        time.sleep(SETTLE_TIME)
        counts = links(self.session)
        if max(counts.values(), default=0) < 2:  # noqa: PLR2004 - two links to one
            return
        back = self._surplus(counts)
        if back:
            self.dials = [endpoint for endpoint in self.dials if endpoint not in back]
            self.session.close()  # type: ignore[no-untyped-call]
            self.session = self._open()

    def _surplus(self, counts: Counter[str]) -> set[str]:
        """Return the endpoints that are dialled in vain."""
        mine = str(self.session.info.zid())
        settled = {info.zid for info in ask(self.session, self._places.domain)}
        with ThreadPoolExecutor(len(self.dials)) as pool:
            routers = pool.map(self._router, self.dials)
            behind = dict(zip(self.dials, routers, strict=True))
        back: set[str] = set()
        for zid, count in counts.items():
            own = [endpoint for endpoint, router in behind.items() if router == zid]
            back |= set(own[1:])  # two ways to one agent
            if count > len(own) and (zid in settled or zid > mine):
                back |= set(own)
        return back

    def _open(self) -> zenoh.Session:
        self._places.remove(self._places.sock)  # of a killed agent; the lock is ours
        return session.agent(
            self._places,
            listen=self._listen,
            dial=self.dials,
            multicast=self._multicast,
            key_folder=self._key_folder,
        )

    def _not_dialled_by(self, wanted: Sequence[str]) -> list[str]:
        """Return the endpoints behind which nobody says that it dials this agent."""
        wanted = list(dict.fromkeys(wanted))
        if not wanted:
            return []
        with ThreadPoolExecutor(len(wanted)) as pool:
            infos = list(pool.map(self._behind, wanted))
        mine = [self._places.endpoint, *self._listen]
        return [
            endpoint
            for endpoint, info in zip(wanted, infos, strict=True)
            if info is None or not any(is_mine(e, mine) for e in info.dials)
        ]

    def _behind(self, endpoint: str) -> m.AgentInfo | None:
        """Return the agent behind an endpoint, if there is one now."""
        with self._client(endpoint) as link:
            if link is None:
                return None
            near = {str(zid) for zid in link.info.routers_zid()}
            found = [i for i in ask(link, self._places.domain) if i.zid in near]
        return found[0] if found else None

    def _router(self, endpoint: str) -> str:
        """Return the zenoh identity of the agent behind an endpoint."""
        with self._client(endpoint) as link:
            zids = link.info.routers_zid() if link is not None else []
            return str(zids[0]) if zids else ""

    @contextlib.contextmanager
    def _client(self, endpoint: str) -> Generator[zenoh.Session | None, None, None]:
        try:
            link = session.client(
                self._places.domain,
                connect=[endpoint],
                timeout=0.0,
                local=False,
                key_folder=self._key_folder,
            )
        except PbonetError:
            yield None
            return
        try:
            yield link
        finally:
            link.close()  # type: ignore[no-untyped-call]


def neighbours(places: rundir.Places) -> list[str]:
    """Return the sockets of the other agents of the domain on this machine."""
    return [
        rundir.Places(places.domain, name).endpoint
        for name in rundir.live_agents(places.domain)
        if name != places.name
    ]


def ask(link: zenoh.Session, domain: str) -> list[m.AgentInfo]:
    """Return who the agents within reach are, in no order."""
    packer = codec.Codec()
    found: list[m.AgentInfo] = []
    replies = link.get(
        keys.all_rtpus(domain, "status"),
        payload=packer.pack(m.Hello(id="who")),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=ASK_TIME,
    )
    for reply in replies:
        if reply.ok is None:
            continue
        with contextlib.suppress(PbonetError, msgspec.ValidationError):
            answer = packer.answer(reply.ok.payload.to_bytes())
            found.append(msgspec.convert(answer.result, m.AgentInfo))
    return found


def links(link: zenoh.Session) -> Counter[str]:
    """Return how many links there are to each router, by its zenoh identity."""
    routers = {str(zid) for zid in link.info.routers_zid()}
    return Counter(zid for one in link.info.links() if (zid := str(one.zid)) in routers)


def _address(endpoint: str) -> str:
    return endpoint.partition("?")[0].partition("#")[0]


def is_mine(endpoint: str, listens: Iterable[str]) -> bool:
    """Tell whether an endpoint that another agent dials is one that is listened on."""
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
    """Tell whether an address belongs to this machine, by binding to it."""
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)
    except OSError:
        return False
    for family, kind, _, _, address in found:
        with contextlib.suppress(OSError), socket.socket(family, kind) as probe:
            probe.bind(address)
            return True
    return False


__all__ = ["Dialled", "ask", "is_mine", "links", "neighbours"]
