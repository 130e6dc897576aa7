"""The paths to the other agents: round trips and clock offsets.

Every second each agent asks every other agent of its domain for its identity, and
measures the offset of the other machine's clock (`pbonet.node.wire.clock_offsets`).
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING

import msgspec
import zenoh

from pbonet.errors import PbonetError, Severity
from pbonet.node.wire import (
    Clock,
    ClockOffsets,
    RoundTrip,
    RoundTrips,
    round_trip,
    rtpu_messages,
)
from pbonet.versions import LAYERS, spoken
from pbonet.xm.net import (
    codec,
    convert,
    dialling,
    direct,
    key_expressions,
    messages as m,
    session,
)

from . import link_watchdog

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Sequence

    from .stop_orders import Listener

log = logging.getLogger("pbonet.node")

PERIOD = 1.0
"""Seconds between round trips to one agent."""
_END = "end"
"""Last part of the key on which an agent announces its orderly end."""
TRIES = 3
"""Number of round trips for a report."""
ANSWER_TIME = 0.5
"""Time-out of an answer in seconds; agents answer this request at once."""
AGAIN = 10
"""How often a report retries agents that are seen but cannot be asked."""
PAUSE = 0.1
"""Seconds between such retries, while links are being restored."""
LOST_TIME = 86400.0
"""Seconds for which an agent that is no longer seen is reported."""
MOST_LOST = 64
"""Maximum number of agents that are remembered after they are no longer seen."""
_UNASKED = "its agent is seen, but requests do not reach it"


class Peer:
    """Another agent, with its last round trips."""

    def __init__(self) -> None:
        self.trips = RoundTrips()
        self.info: m.AgentInfo | None = None
        self.error = ""
        self.near = False
        """Whether there is a direct link to it."""

    @property
    def best(self) -> RoundTrip | None:
        """The shortest of the last round trips."""
        return self.trips.best

    def add(self, info: m.AgentInfo, trip: RoundTrip) -> None:
        """Add a round trip; earlier ones to another machine are dropped."""
        if self.info is not None and self.info.machine != info.machine:
            self.trips = RoundTrips()
        self.info, self.error = info, ""
        self.trips.add(trip)


class PeerLatencies:
    """The measurement of the paths from one agent to the others.

    Args:
        link: The agent's session.
        me: The agent's identity.
        tell: Called with the clock offsets, every second.
        note: Called with reports for masters.
        listeners: Learn of each greeting, and of agents that are lost or have ended.
        silent: Returns whether an agent is out of sight, though its link is kept.
    """

    def __init__(
        self,
        link: zenoh.Session,
        me: Callable[[], m.AgentInfo],
        tell: Callable[[rtpu_messages.Clocks], None] | None = None,
        note: Callable[[rtpu_messages.Note], None] | None = None,
        *,
        listeners: Sequence[Listener] = (),
        silent: Callable[[str], bool] = lambda _name: False,
    ) -> None:
        self._session = link
        self._me = me
        self._tell = tell
        self._note = note
        self._listeners = listeners
        self._silent = silent
        self._peers: dict[str, Peer] = {}
        self._lost: dict[str, tuple[m.Lost, float]] = {}
        """Agents that were seen, and when a search for them first failed."""
        self.clocks = ClockOffsets()
        """The other machines' clocks, also while a machine is not seen."""
        self._machines: dict[str, str] = {}
        """The machine of each agent that has answered, in the form used in keys."""
        self._back: set[str] = set()
        """Agents that came in sight again since the last check of links."""
        self._ended: dict[str, int] = {}
        """Agents that have announced their end, and when (monotonic ns)."""
        self._watchdog = link_watchdog.LinkWatchdog(link)
        self._guard = threading.Lock()
        self._over = threading.Event()
        self._wake = threading.Event()
        """Set when agents have appeared or are gone, and at the end."""
        self._new: set[str] = set()
        """Agents that have appeared since the last round trips."""
        self._table_version = LAYERS["table"].oldest
        self._codec = codec.Codec()
        self._thread = threading.Thread(
            target=self._watch, name="pbonet ways", daemon=True
        )

    def start(self) -> None:
        """Start to ask every second."""
        self._subscriber = self._session.declare_subscriber(
            key_expressions.all_rtpus(self._me().domain, _END),
            direct(self._on_end),
        )
        self._tokens = self._session.liveliness().declare_subscriber(
            key_expressions.all_rtpus(self._me().domain, "alive"),
            direct(self._on_token),
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop asking."""
        self._over.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()

    def announce_end(self) -> None:
        """Tell the others that this agent's tasks are OFF and will not come back.

        To be called when it answers no greeting any more; see `_on_end`.
        """
        with contextlib.suppress(zenoh.ZError):
            me = self._me()
            key = key_expressions.rtpu(me.domain, me.name, _END)
            self._session.put(key, b"")  # pyright: ignore[reportUnknownMemberType]

    def unlinked(self, endpoints: Sequence[str]) -> list[str]:
        """Return the TLS endpoints without a link."""
        wanted = [one for one in endpoints if one.startswith("tls/")]
        with contextlib.suppress(zenoh.ZError):
            there = {
                link_watchdog.plain(str(one.dst)) for one in self._session.info.links()
            }
            ports = Counter(_port(link_watchdog.plain(one)) for one in wanted)
            ports.subtract(_port(one) for one in there)
            if any(count > 0 for count in ports.values()):  # otherwise resolve no name
                return [
                    o for o in wanted if there.isdisjoint(link_watchdog.resolved(o))
                ]
        return []

    def lost(self) -> list[m.Lost]:
        """Return the agents that were seen and are no longer seen."""
        if not self._lost:
            return []
        now = time.monotonic()
        with self._guard:
            found = sorted(self._lost.items())
        return [
            msgspec.structs.replace(one, ago=now - at)
            for _, (one, at) in found
            if now - at < LOST_TIME
        ]

    def out_of_sight(self, name: str) -> None:
        """Record that an agent is out of sight; may be called from any thread."""
        with self._guard:
            peer = self._peers.pop(name, None)
            if peer is not None:
                self._lose(name, peer)
        for one in self._listeners:
            one.lost(name)

    def in_sight(self, name: str) -> None:
        """Record that it is in sight again; may be called from any thread."""
        with self._guard:
            self._lost.pop(name, None)
            self._back.add(name)
            self._appeared(name)
        self._wake.set()

    def _appeared(self, name: str) -> None:
        """Have an agent asked that may be of another version than those in sight."""
        self._new.add(name)
        self._table_version = LAYERS["table"].oldest

    def _on_end(self, sample: zenoh.Sample) -> None:
        """Record the orderly end of an agent; runs in zenoh's own thread.

        One that is not seen cannot announce it, and one that answers has not ended.
        """
        name = key_expressions.rtpu_name(str(sample.key_expr))
        with self._guard:
            if name not in self._peers:
                return
            self._ended[name] = time.monotonic_ns()
        for one in self._listeners:
            one.ended(name)

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Let an agent that has appeared be asked now, or one that is gone be noted.

        Runs in zenoh's own thread.
        """
        name = key_expressions.rtpu_name(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT:
            with self._guard:
                self._appeared(name)
        else:
            for one in self._listeners:
                one.lost(name)
        self._wake.set()

    def table_version(self) -> int:
        """Return the version of table packets that all agents in sight understand.

        It is the oldest of this agent's while one of them has not told its own.
        """
        return self._table_version

    def clock(self, name: str) -> Clock | None:
        """Return the clock of an agent's machine, if it is known."""
        machine = self._machines.get(name)
        return (machine and self.clocks.clock(machine, time.monotonic_ns())) or None

    def report(self, *, measure: bool = True) -> m.LinkReport:
        """Return what is known of the paths to the others.

        Args:
            measure: Measure now; else it is from the last second, and nothing is sent.
        """
        me = self._me()
        if measure:
            self._measure_now(me.name)
        counts = dialling.links(self._session)
        with self._guard:
            peers = sorted(self._peers.items())
        ways = [_way(name, peer, me) for name, peer in peers]
        names = {p.info.zid: name for name, p in peers if p.info is not None}
        double = [names.get(zid, zid) for zid, count in counts.items() if count > 1]
        unseen = sorted(
            one.name for one in self._watchdog.unseen(_seen(peers)).values()
        )
        return m.LinkReport(
            rtpu=me.name, ways=ways, double=sorted(double), unseen=unseen
        )

    def _measure_now(self, me: str) -> None:
        """Make round trips to all, and more to those that cannot be asked yet."""
        for _ in range(TRIES):
            self._measure(me)
        for _ in range(AGAIN):
            with self._guard:
                left = {n for n, peer in self._peers.items() if peer.error == _UNASKED}
            if not left or self._over.wait(PAUSE):
                break
            self._measure(me, left)

    def _watch(self) -> None:
        due = time.monotonic() + PERIOD
        while not self._over.is_set():
            self._wake.wait(max(0.0, due - time.monotonic()))
            self._wake.clear()
            with self._guard:
                new, self._new = self._new, set()
            if time.monotonic() < due:
                self._measure_quietly(new)
                continue
            due = time.monotonic() + PERIOD
            try:
                self._measure(self._me().name)
                self._relink_unseen()
            except (zenoh.ZError, OSError) as error:
                log.debug("the connections cannot be measured: %s", error)
            if self._tell is not None and (others := self._apart()):
                self._tell(rtpu_messages.Clocks(self._me().machine, others))

    def _measure_quietly(self, names: set[str]) -> None:
        try:
            self._measure(self._me().name, names)
        except (zenoh.ZError, OSError) as error:
            log.debug("the connections cannot be measured: %s", error)

    def _relink_unseen(self) -> None:
        """Reopen links through which neighbours are not seen."""
        with self._guard:
            seen = {*_seen(self._peers.items()), *self._back}
            self._back.clear()
        for name in self._watchdog.cut_silent(seen):
            text = f"the link to agent {name} transferred nothing; it is opened again"
            log.warning("%s: %s", self._me().name, text)
            if self._note is not None:
                self._note(
                    rtpu_messages.Note(int(Severity.WARNING), "LINK_RENEWED", text)
                )

    def _apart(self) -> list[rtpu_messages.Apart]:
        """Return the offsets of other machines' clocks from this one's."""
        mine = self._me().machine
        with self._guard:
            return [
                rtpu_messages.Apart(
                    name, info.machine, best.offset_ns, round(best.seconds * 5e8)
                )
                for name, peer in sorted(self._peers.items())
                if (info := peer.info) is not None
                and info.machine != mine
                and (best := peer.best) is not None
                and not peer.error
            ]

    def _measure(self, me: str, wanted: Container[str] | None = None) -> None:
        """Make one round trip to each agent that is seen, or to those in `wanted`."""
        domain, machine = self._me().domain, self._me().machine
        names = [
            name
            for name in session.rtpus(self._session, domain)
            if name != me and not self._silent(name)
        ]
        near = {str(zid) for zid in self._session.info.routers_zid()}
        with self._guard:
            for gone in self._peers.keys() - set(names):
                self._lose(gone, self._peers.pop(gone))
            for name in names:
                self._lost.pop(name, None)
        for name in names:
            if wanted is not None and name not in wanted:
                continue
            peer = self._peers.setdefault(name, Peer())
            begin = time.monotonic_ns()
            found = self._ask(key_expressions.rtpu(domain, name, "status"))
            end = time.monotonic_ns()
            with self._guard:
                if isinstance(found, m.AgentInfo):
                    if self._ended.get(name, begin) < begin:
                        del self._ended[name]  # it has restarted
                    trip = round_trip(begin, end, found.now_ns)
                    peer.add(found, trip)
                    self._machines[name] = key_expressions.machine(found.machine)
                    self.clocks.add(self._machines[name], trip)
                    peer.near = found.zid in near
                    self._watchdog.met(found, here=found.machine == machine)
                else:
                    peer.error = found
            if isinstance(found, m.AgentInfo):
                for one in self._listeners:
                    one.met(found)
        with self._guard:
            if not self._new:  # those have not told their versions yet
                infos = [peer.info for peer in self._peers.values()]
                ranges = [i.understands("table") if i else None for i in infos]
                self._table_version = spoken(LAYERS["table"], ranges)

    def _lose(self, name: str, peer: Peer) -> None:
        """Remember agents that are no longer seen, unless they announced their end."""
        if self._ended.pop(name, 0):
            return
        if peer.info is not None:
            host, on = peer.info.host, peer.info.on
            lost = m.Lost(rtpu=name, host=host, near=peer.near, ago=0.0, on=on)
            self._lost[name] = lost, time.monotonic()
            while len(self._lost) > MOST_LOST:
                self._lost.pop(next(iter(self._lost)))

    def _ask(self, key: str) -> m.AgentInfo | str:
        """Return the identity of the agent that answers on a key, or the reason."""
        replies = self._session.get(
            key, payload=self._codec.pack(m.Hello(id="way")), timeout=ANSWER_TIME
        )
        for reply in replies:
            if reply.ok is None:
                return f"no answer within {ANSWER_TIME:g} s"
            try:
                answer = self._codec.answer(reply.ok.payload.to_bytes())
                if answer.ok:
                    return convert(answer.result, m.AgentInfo)
                return str(PbonetError.from_wire(answer.error or {}))
            except (PbonetError, msgspec.ValidationError) as error:
                return str(error)
        return _UNASKED


def _port(address: str) -> str:
    """Return the port of an address in the form of `link_watchdog.plain`."""
    return address.rpartition(" ")[2]


def _seen(peers: Iterable[tuple[str, Peer]]) -> list[str]:
    """Return the names of agents that can be asked, even if they answer late."""
    return [name for name, peer in peers if peer.error != _UNASKED]


def _way(name: str, peer: Peer, me: m.AgentInfo) -> m.Way:
    info, best = peer.info, peer.best
    if peer.error or info is None or best is None:
        return m.Way(rtpu=name, error=peer.error or "not yet asked")
    hops = 1 if peer.near else 2
    return m.Way(
        rtpu=name,
        host=info.host,
        version=info.version,
        trip=best.seconds,
        offset=best.offset_ns * 1e-9,
        spread=best.seconds / 2,
        hops=0 if info.machine == me.machine else hops,
    )
