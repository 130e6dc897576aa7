"""The paths to other agents: round trips and clock offsets.

Every second an agent asks its partners for their identity, which are those with which
it shares a subsystem or a link, and measures the offset of the other machine's clock
(`pbonet.node.wire.clock_offsets`). It also asks `ASKED` of the `WATCHED` agents that
come after it in a circle of all names (`watched_agents`), in turn. So each agent is
known to a few that it has nothing to do with: they tell of its loss, and repeat a stop
to it. Of all others an agent knows only that they are there.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
import zlib
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
WATCHED = 8
"""Other agents whose identity an agent knows though it shares nothing with them."""
ASKED = 1
"""How many of these it asks each second: a question costs each side half a millisecond
of CPU time, most of it for waking zenoh's threads."""
CHECKED = 10
"""Seconds between two checks of which tokens there are."""
_END = "end"
"""Last part of the key on which an agent announces its orderly end."""
_CHANGED = "changed"
"""Last part of the key on which it announces that other subsystems use its RTPU."""
TRIES = 3
"""Number of round trips for a report."""
ANSWER_TIME = 0.5
"""Time-out of an answer in seconds; agents answer this request at once."""
AGAIN = 10
"""How often a report retries agents that are seen but cannot be asked."""
PAUSE = 0.1
"""Seconds between such retries, while links are being restored."""
FRESH_NS = 20_000_000_000
"""How long an offset is recorded after its measurement. A neighbour that is asked once
is known for longer."""
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
        token_came: Called when an agent's token has appeared.
        partners: Returns the agents that are asked every second.
        knows_all: Watch all agents: commands of masters pass through this one.
        by_router: Its links lead to routers, which are no agents and answer nothing.
    """

    def __init__(
        self,
        link: zenoh.Session,
        me: m.AgentInfo,
        tell: Callable[[rtpu_messages.Clocks], None] | None = None,
        note: Callable[[rtpu_messages.Note], None] | None = None,
        *,
        listeners: Sequence[Listener] = (),
        silent: Callable[[str], bool] = lambda _name: False,
        token_came: Callable[[str], None] = lambda _name: None,
        partners: Callable[[], set[str]] = set,
        knows_all: bool = False,
        by_router: bool = False,
    ) -> None:
        self._session = link
        self._me = me
        self._tell = tell
        self._note = note
        self._listeners = listeners
        self._silent, self._token_came = silent, token_came
        self._partners = partners
        self._most = None if knows_all else WATCHED
        self._by_router = by_router
        self._alive: set[str] = set()
        """Agents whose tokens are seen."""
        self._missed: set[str] = set()
        """Agents among them that the last check of the tokens has not found."""
        self._gone: set[str] = set()
        """Agents whose tokens have gone since that check began."""
        self._watched: list[str] | None = []
        """See `watched_agents`; None: to be determined again."""
        self._turn = 0
        """Which of these are asked next."""
        self._tried: set[str] = set()
        """Agents that were asked in search of neighbours."""
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
        self._heard_by = 0.0
        """When those of a group that was joined have been heard."""
        self._codec = codec.Codec()
        self._thread = threading.Thread(
            target=self._watch, name="pbonet ways", daemon=True
        )

    def start(self) -> None:
        """Start to ask every second."""
        self._subscriber = self._session.declare_subscriber(
            key_expressions.all_rtpus(self._me.domain, _END),
            direct(self._on_end),
        )
        self._changes = self._session.declare_subscriber(
            key_expressions.all_rtpus(self._me.domain, _CHANGED),
            direct(self._on_change),
            allowed_origin=zenoh.Locality.REMOTE,
        )
        self._tokens = self._session.liveliness().declare_subscriber(
            key_expressions.all_rtpus(self._me.domain, "alive"),
            direct(self._on_token),
            history=True,
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
        self._announce(_END)

    def announce_change(self) -> None:
        """Let those that watch this agent ask at once which subsystems use its RTPU."""
        self._announce(_CHANGED)

    def _announce(self, leaf: str) -> None:
        with contextlib.suppress(zenoh.ZError):
            me = self._me
            key = key_expressions.rtpu(me.domain, me.name, leaf)
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

    def expect_others(self) -> None:
        """Send tables in the oldest version until those in the group are known.

        They give their signs of life ten times a second, and are asked then. A packet
        that one of them cannot read would raise its flag.
        """
        with self._guard:
            self._heard_by = time.monotonic() + session.SILENT_MS * 1e-3
            self._table_version = LAYERS["table"].oldest

    def need(self, name: str) -> None:
        """Ask an agent now, which is a partner; may be called from any thread."""
        with self._guard:
            self._new.add(name)
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
            self._token_came(name)
            with self._guard:
                self._alive.add(name)
                self._new.add(name)
                self._watched = None
        else:
            with self._guard:
                self._alive.discard(name)
                self._gone.add(name)
                self._tried.discard(name)
                self._watched = None
            for one in self._listeners:
                one.lost(name)
        self._wake.set()

    def _on_change(self, sample: zenoh.Sample) -> None:
        """Ask an agent whose subsystems have changed; runs in zenoh's own thread."""
        name = key_expressions.rtpu_name(str(sample.key_expr))
        if name in self._peers:
            self.need(name)

    def _check_tokens(self) -> None:
        """Compare the tokens that the subscriber has reported with all that exist.

        A search beside a subscriber may miss a token (`session.alive`), so one must be
        missed twice; and it may find one that has gone meanwhile.
        """
        with self._guard:
            self._gone.clear()
        found = set(session.rtpus(self._session, self._me.domain))
        with self._guard:
            found -= self._gone - self._alive
            missing = self._alive - found
            gone = missing & self._missed
            self._missed = missing
            if gone or found - self._alive:
                self._alive = (self._alive | found) - gone
                self._watched = None

    def _wanted(self, me: str) -> tuple[set[str], list[str]]:
        """Return the partners, and the agents that are watched beside them."""
        partners = self._partners() - {me}
        with self._guard:
            if self._watched is None:
                others = self._alive - {me}
                self._watched = watched_agents(me, others, self._most)
            return partners, [one for one in self._watched if one not in partners]

    def table_version(self) -> int:
        """Return the version of table packets that all agents in sight understand.

        It is the oldest of this agent's while one of them has not reported its own.
        """
        return self._table_version

    def machine(self, name: str) -> str | None:
        """Return the machine of an agent that has answered, in the form of keys."""
        return self._machines.get(name)

    def clock(self, name: str) -> Clock | None:
        """Return the clock of an agent's machine, if it is known."""
        machine = self._machines.get(name)
        return (machine and self.clocks.clock(machine, time.monotonic_ns())) or None

    def report(self, *, measure: bool = True) -> m.LinkReport:
        """Return what is known of the paths to the others.

        Args:
            measure: Measure the paths to all now; else nothing is sent, and the report
                has what is known.
        """
        me = self._me
        others = self._measure_now(me.name) if measure else {}
        counts = dialling.links(self._session)
        with self._guard:
            peers = sorted((others | self._peers).items())
            alive = len(self._alive - {me.name})
        ways = [_way(name, peer, me) for name, peer in peers]
        names = {p.info.zid: name for name, p in peers if p.info is not None}
        double = [names.get(zid, zid) for zid, count in counts.items() if count > 1]
        unseen = sorted(
            one.name for one in self._watchdog.unseen(self._seen()).values()
        )
        return m.LinkReport(
            rtpu=me.name,
            ways=ways,
            double=sorted(double),
            unseen=unseen,
            alive=alive,
        )

    def _measure_now(self, me: str) -> dict[str, Peer]:
        """Make round trips to all; return the agents of which nothing is kept.

        More are made to those that cannot be asked yet.
        """
        partners, watched = self._wanted(me)
        with self._guard:
            kept = {*partners, *watched, *self._peers}
        others: dict[str, Peer] = {}
        for _ in range(TRIES):
            self._check_tokens()
            with self._guard:
                names = self._alive - {me}
            for name in names - kept:
                self._ask_once(name, others.setdefault(name, Peer()), kept=False)
            self._measure(me, names & kept)
        for _ in range(AGAIN):
            with self._guard:
                left = {n for n, peer in self._peers.items() if peer.error == _UNASKED}
            if not left or self._over.wait(PAUSE):
                break
            self._measure(me, left)
        return others

    def _watch(self) -> None:
        due = time.monotonic() + PERIOD
        seconds = 0
        while not self._over.is_set():
            self._wake.wait(max(0.0, due - time.monotonic()))
            self._wake.clear()
            if time.monotonic() < due:
                self._quietly(self._ask_new)
                continue
            due = time.monotonic() + PERIOD
            seconds += 1
            if seconds % CHECKED == 0:
                self._quietly(self._check_tokens)
            self._quietly(self._ask_due)
            self._quietly(self._relink_unseen)
            if self._tell is not None and (others := self._apart()):
                self._tell(rtpu_messages.Clocks(self._me.machine, others))

    def _ask_new(self) -> None:
        """Ask the agents that have appeared, if they are partners or watched."""
        with self._guard:
            new, self._new = self._new, set()
        me = self._me.name
        partners, watched = self._wanted(me)
        with self._guard:
            known = {*partners, *watched, *self._peers}
        if concerned := new & known:
            self._measure(me, concerned)
        else:
            self._forget_lost(me)

    def _ask_due(self) -> None:
        """Ask all partners, and the next of the others."""
        with self._guard:
            new, self._new = self._new, set()
        me = self._me.name
        partners, watched = self._wanted(me)
        asked = set(partners)
        if watched:
            first = self._turn = (self._turn + ASKED) % len(watched)
            asked.update((watched + watched)[first : first + ASKED])
        asked.update(name for name in watched if name in new or name not in self._peers)
        self._drop({*partners, *watched})
        self._measure(me, asked | self._unknown_neighbours(me))

    def _unknown_neighbours(self, me: str) -> set[str]:
        """Return agents that may be at the end of a link to an unknown one.

        Each is asked once; one that is no neighbour is dropped again.
        """
        if self._by_router or not self._watchdog.unknown():
            return set()
        with self._guard:
            left = self._alive - self._tried - self._peers.keys() - {me}
            found = set(sorted(left)[:ASKED])
            self._tried |= found
        return found

    def _drop(self, wanted: set[str]) -> None:
        """Drop what is known of agents that are there, and are not to be known."""
        with self._guard:
            strangers = self._peers.keys() & self._alive - wanted
            dropped = [name for name in strangers if not self._peers[name].near]
            for name in dropped:
                del self._peers[name]
        for name in dropped:
            for one in self._listeners:
                one.dropped(name)

    def _quietly(self, what: Callable[[], object]) -> None:
        try:
            what()
        except (zenoh.ZError, OSError) as error:
            log.debug("the connections cannot be measured: %s", error)

    def _relink_unseen(self) -> None:
        """Reopen links through which neighbours are not seen."""
        seen = self._seen()
        with self._guard:
            seen |= self._back
            self._back.clear()
        for name in self._watchdog.cut_silent(seen):
            text = f"the link to agent {name} transferred nothing; it is opened again"
            log.warning("%s: %s", self._me.name, text)
            if self._note is not None:
                self._note(
                    rtpu_messages.Note(int(Severity.WARNING), "LINK_RENEWED", text)
                )

    def _seen(self) -> set[str]:
        """Return the agents that are in sight and can be asked, even if late."""
        with self._guard:
            deaf = {n for n, peer in self._peers.items() if peer.error == _UNASKED}
            there = self._alive - deaf
        return {name for name in there if not self._silent(name)}

    def _apart(self) -> list[rtpu_messages.Apart]:
        """Return the offsets of other machines' clocks from this one's."""
        mine, now_ns = self._me.machine, time.monotonic_ns()
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
                and now_ns - best.at_ns < FRESH_NS
            ]

    def _forget_lost(self, me: str) -> list[str]:
        """Return the agents in sight; keep apart those that are not any more."""
        with self._guard:
            there = self._alive - {me}
        names = [name for name in sorted(there) if not self._silent(name)]
        with self._guard:
            for gone in self._peers.keys() - set(names):
                self._lose(gone, self._peers.pop(gone))
            for name in self._lost.keys() & set(names):
                del self._lost[name]
        return names

    def _measure(self, me: str, wanted: Container[str]) -> None:
        """Make one round trip to each agent in `wanted` that is in sight."""
        for name in self._forget_lost(me):
            if name in wanted:
                with self._guard:
                    peer = self._peers.setdefault(name, Peer())
                self._ask_once(name, peer)
        with self._guard:
            # All have reported by then.
            if not self._new and time.monotonic() >= self._heard_by:
                infos = [peer.info for peer in self._peers.values()]
                ranges = [i.understands("table") if i else None for i in infos]
                self._table_version = spoken(LAYERS["table"], ranges)

    def _ask_once(self, name: str, peer: Peer, *, kept: bool = True) -> None:
        """Make one round trip to an agent; listeners learn of it if it is kept."""
        me = self._me
        begin = time.monotonic_ns()
        found = self._ask(key_expressions.rtpu(me.domain, name, "status"))
        end = time.monotonic_ns()
        with self._guard:
            if not isinstance(found, m.AgentInfo):
                peer.error = found
                return
            if self._ended.get(name, begin) < begin:
                del self._ended[name]  # it has restarted
            trip = round_trip(begin, end, found.now_ns)
            peer.add(found, trip)
            self._machines[name] = key_expressions.machine(found.machine)
            self.clocks.add(self._machines[name], trip)
            peer.near = self._watchdog.met(found, here=found.machine == me.machine)
        for one in self._listeners if kept else ():
            one.met(found)

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


def watched_agents(me: str, others: Iterable[str], most: int | None) -> list[str]:
    """Return the agents that come after `me` in a circle of all names, by their sums.

    So each agent is watched by as many as it watches. The circle is not in order of the
    names: those of one machine are often alike, and would be lost together.

    Args:
        me: The agent that watches.
        others: The other agents.
        most: How many are watched; None: all.
    """
    if most is None:
        return sorted(others)
    place = _place(me)
    ranks = sorted((_place(name) <= place, _place(name), name) for name in others)
    return [name for *_, name in ranks[:most]]


def _place(name: str) -> int:
    return zlib.crc32(name.encode())


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
