"""Signs of life between agents, and the care for their links during an interruption.

Agents whose RTPUs have the table of one subsystem are a group, and give each other
signs of life on a key of that subsystem. No other agent hears these, and one without
a table gives and hears none. One leaves a group when its RTPU has not had the table for
a while, and says so: an RTPU process that was killed soon has it again.

An agent that gives no sign of life for 0.4 s is out of sight: its machine's variables
have no writer then, though the link is kept for some seconds, because an interruption
is often over before a new link could be made.

A sign of life also says whose signs of life its sender hears. So an agent knows that it
is heard, and since when it may not be: what it must do alone (``ALONE``) is counted
from the last of its own signs of life that was answered. A machine that was out of
reach and has orders to carry out (`stop_orders`) is not answered before it has done so.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import zenoh
from msgspec import Struct

from pbonet.node.wire import process_setup
from pbonet.xm.net import direct, key_expressions, session

from .retransmission import IDLE, Retransmission

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from pbonet.xm.net import AgentInfo

log = logging.getLogger("pbonet.node")

PERIOD = 0.1
"""Seconds between two signs of life."""
LEAST = 1e-3
"""Shortest time between two checks, in seconds."""
LINGER = 60.0
"""Seconds for which an agent stays in the group of a table that its RTPU has closed or
lost."""
FIND_PERIOD = 10.0
"""Seconds between searches for connections that zenoh has not reported."""
SELDOM = 0.5
"""Seconds between checks of links that are not needed: this agent has no table, is not
used, and passes no messages on."""
FORGET = 60.0
"""Seconds after which an agent that is out of sight is forgotten."""
HELD = -1
"""Answers a sign of life of a machine that has orders to carry out."""
ALWAYS = -math.inf
"""When an agent joined a group of which another one before it may have been."""


class Beat(Struct, array_like=True):
    """A sign of life."""

    machine: str
    """The sender's, in the form used in keys."""
    sent_ns: int
    """CLOCK_MONOTONIC of that machine."""
    heard: dict[str, int]
    """The agents that the sender hears: `sent_ns` of each one's last sign of life, or
    `HELD`."""
    leaves: bool = False
    """Whether it is the last one: the sender leaves the group."""


class Change(NamedTuple):
    """An agent that came into sight again, or went out of sight."""

    agent: str
    machine: str
    """In the form used in keys."""
    seen: bool
    last: bool
    """Whether no other agent of that machine is in sight."""


class _Agent:
    """Another agent of the domain."""

    def __init__(self, machine: str, answered: float = 0.0) -> None:
        self.machine = machine
        self.heard = self.back = time.monotonic()
        self.seen = True
        self.back_without = False
        """Whether its token has come since its last sign of life: it may have started
        again, without a table, even before the silence of the one before it is seen."""
        self.groups: set[str] = set()
        """Subsystems in whose groups it was heard."""
        self.sent_ns = 0
        """Of its last sign of life, by the clock of its machine."""
        self.answered = answered
        """When the last sign of life was sent that it has answered."""
        self.holds = False
        """Whether it says that there are orders to carry out here."""
        self.answers: dict[str, int] = {}
        """The last answer that it gave each agent."""
        self.told: dict[str, float] = {}
        """When its answer to each agent was last a new one."""

    def take(self, beat: Beat, me: str, now: float) -> None:
        """Take a sign of life."""
        if not self.seen:
            self.back = now
        self.seen, self.back_without = True, False
        self.heard, self.sent_ns = now, beat.sent_ns
        self.holds = beat.heard.get(me) == HELD
        for name, sent_ns in beat.heard.items():
            if self.answers.get(name) != sent_ns:
                self.told[name] = now
        self.answers = beat.heard


class _Group:
    """This agent's part in the signs of life of one subsystem.

    Args:
        link: The agent's session.
        key: The key of this agent's signs of life in the group.
        keys: The keys of all.
        take: Called with each sign of life of another agent.
        joined: When the agent joined it, or `ALWAYS`.
    """

    def __init__(
        self,
        link: zenoh.Session,
        key: str,
        keys: str,
        take: Callable[[zenoh.Sample], None],
        joined: float,
    ) -> None:
        self.joined = joined
        self.left: float | None = None
        """Since when the RTPU has not had the table; None: it has it."""
        self._subscriber = link.declare_subscriber(
            keys, direct(take), allowed_origin=zenoh.Locality.REMOTE
        )
        self._publisher = link.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            allowed_destination=zenoh.Locality.REMOTE,
        )

    def put(self, beat: bytes) -> None:
        """Give a sign of life."""
        with contextlib.suppress(zenoh.ZError):
            self._publisher.put(beat)  # pyright: ignore[reportUnknownMemberType]

    def close(self) -> None:
        """Give and hear none any more."""
        for entity in (self._subscriber, self._publisher):
            with contextlib.suppress(zenoh.ZError):
                entity.undeclare()  # type: ignore[no-untyped-call]


class Heartbeat:
    """An agent's signs of life, and those of the others in its groups.

    Args:
        link: The agent's session.
        me: The agent's identity.
        report: Called when another agent goes out of sight or comes back, in zenoh's
            thread or in one of its own.
        holds: Returns whether a machine must carry out orders before it is answered.
        met: Called with an agent that is heard for the first time, in the same way.
        machine_of: Returns the machine of an agent that has reported it otherwise, in
            the form used in keys.
        used: Returns whether masters or programs elsewhere use this agent's RTPU.
    """

    def __init__(
        self,
        link: zenoh.Session,
        me: AgentInfo,
        report: Callable[[Change], None],
        holds: Callable[[str], bool] = lambda _machine: False,
        *,
        met: Callable[[str], None] = lambda _name: None,
        machine_of: Callable[[str], str | None] = lambda _name: None,
        used: Callable[[], bool] = lambda: False,
    ) -> None:
        self._session, self._report, self._holds = link, report, holds
        self._met, self._machine_of, self._used = met, machine_of, used
        self._domain, self._name = me.domain, me.name
        self._machine = key_expressions.machine(me.machine)
        self._decoder = msgspec.msgpack.Decoder(Beat)
        self._encoder = msgspec.msgpack.Encoder()
        self._agents: dict[str, _Agent] = {}
        self._groups: dict[str, _Group] = {}
        """By subsystem."""
        self._began = self._next_beat = self._next_find = time.monotonic()
        self._guard = threading.Lock()
        self._joining = threading.Lock()
        """Held while groups are joined."""
        self._over = False
        self._wake = threading.Event()
        self._retransmission = Retransmission()
        self._passes_on = True
        """Whether there is more than one link: others may depend on this agent."""
        self._listener: zenoh.LinkEventsListener[None] | None = None
        self._thread = threading.Thread(
            target=self._work, name="pbonet beat", daemon=True
        )

    def start(self) -> None:
        """Start to look after the links, and to give signs of life in groups."""
        # Called by a thread of its own: zenoh's must not wait while it opens a link.
        self._listener = self._session.info.declare_link_events_listener(self._on_link)
        self._thread.start()

    def stop(self) -> None:
        """End both."""
        if self._listener is not None:
            with contextlib.suppress(zenoh.ZError):
                self._listener.undeclare()  # type: ignore[no-untyped-call]
        self._over = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()

    def join(self, subsystems: Collection[str], *, since: float | None = None) -> None:
        """Join the groups of exactly these subsystems; others are left after `LINGER`.

        Args:
            subsystems: Those of which the RTPU has the table.
            since: When the RTPU got the tables that are new; now, if it is not given.
        """
        now = time.monotonic()
        with self._joining:
            for subsystem, group in self._groups.items():
                there = subsystem in subsystems
                group.left = None if there else group.left or now
            for subsystem in [one for one in subsystems if one not in self._groups]:
                group = _Group(
                    self._session,
                    key_expressions.beat(self._domain, subsystem, self._name),
                    key_expressions.beat(self._domain, subsystem),
                    self._note_beat,
                    now if since is None else since,
                )
                with self._guard:
                    self._groups[subsystem] = group
                self._next_beat = now
        self._wake.set()

    def groups(self) -> set[str]:
        """Return the subsystems in whose groups this agent is."""
        with self._guard:
            return {*self._groups}

    def is_needed(self) -> bool:
        """Return whether an agent, a master or a program depends on its links."""
        return self._passes_on or bool(self._groups) or self._used()

    def partners(self) -> set[str]:
        """Return the other agents of the groups, also those out of sight."""
        with self._guard:
            return {*self._agents}

    def is_here(self, name: str) -> bool:
        """Return whether an agent is known to be on this machine."""
        with self._guard:
            return self._of_machine(name) is None

    def silence(self, subsystem: str, name: str) -> float:
        """Return for how many seconds an agent's machine has surely not answered.

        No agent can answer before this one has joined the group, so that counts as an
        answer, unless an agent before this one was in it already.
        """
        with self._guard:
            group = self._groups.get(subsystem)
        joined = group.joined if group is not None else ALWAYS
        return min(self.unanswered(name), time.monotonic() - joined)

    def unanswered(self, name: str) -> float:
        """Return for how many seconds an agent's machine has not answered.

        That is since the last sign of life from here that any agent of it has answered;
        infinite before the first answer. Nothing counts as one while one of them says
        that there are orders to carry out.
        """
        with self._guard:
            agents = self._of_machine(name)
            if agents is None:
                return 0.0
            answered = max((one.answered for one in agents.values()), default=0.0)
        return time.monotonic() - answered if answered else math.inf

    def absence(self, subsystem: str, name: str, keeper: str) -> float:
        """Return for how many seconds an agent's machine was surely alone.

        It has been heard neither here nor by the machine of the keeper, which must be
        in sight, and not before this agent has joined the group. Infinite for this
        machine, of which other things are known.

        Args:
            subsystem: The subsystem in whose group it was.
            name: The agent.
            keeper: The agent of the keeper's RTPU.
        """
        now = time.monotonic()
        with self._guard:
            lost = self._of_machine(name)
            if lost is None:
                return math.inf
            if name not in self._agents:
                lost = {}  # others of its machine do not speak for one that has left
            group = self._groups.get(subsystem)
            last = [max(self._began, group.joined) if group is not None else now]
            last += [one.heard for one in lost.values()]
            witnesses = self._of_machine(keeper)
            if witnesses is not None:
                there = [one for one in witnesses.values() if one.seen]
                if not there:
                    return 0.0
                last += [one.back for one in there]
                names = {*lost, name}
                last += [one.told.get(n, 0.0) for one in there for n in names]
        return now - max(last)

    def _of_machine(self, name: str) -> dict[str, _Agent] | None:
        """Return the agents of an agent's machine; None if that is this machine.

        The agent itself need not be among them: it has no table, or none any more.
        """
        agent = self._agents.get(name)
        machine = agent.machine if agent is not None else self._machine_of(name)
        if name == self._name or machine == self._machine:
            return None
        return {
            other: one for other, one in self._agents.items() if one.machine == machine
        }

    def is_silent(self, name: str) -> bool:
        """Return whether an agent is out of sight, though its link may still exist."""
        agent = self._agents.get(name)
        return agent is not None and not (agent.seen or agent.back_without)

    def token_came(self, name: str) -> None:
        """Take in that an agent's token has come: it may give no signs of life now."""
        with self._guard:
            agent = self._agents.get(name)
            if agent is not None:
                agent.back_without = True  # until its next sign of life

    def is_seen(self, name: str) -> bool:
        """Return whether an agent is in sight; one that was never heard is not."""
        agent = self._agents.get(name)
        return agent is not None and agent.seen

    def _note_beat(self, sample: zenoh.Sample) -> None:
        """Note a sign of life; runs in zenoh's own thread."""
        subsystem, name = key_expressions.beat_of(str(sample.key_expr))
        try:
            beat = self._decoder.decode(sample.payload.to_bytes())
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return  # of another version: it counts as out of sight
        with self._guard:
            agent = self._agents.get(name)
            if beat.leaves or subsystem not in self._groups:
                self._part(subsystem, name)
                return
            new, back = agent is None, agent is not None and not agent.seen
            if agent is None or agent.machine != beat.machine:
                if agent is not None and agent.seen:
                    return  # first the machine where it was must be out of sight
                answered = agent.answered if agent is not None else 0.0
                agent = self._agents[name] = _Agent(beat.machine, answered)
            now = time.monotonic()
            agent.groups.add(subsystem)
            agent.take(beat, self._name, now)
            if not any(
                one.holds and one.seen
                for one in self._agents.values()
                if one.machine == agent.machine
            ):
                answered = beat.heard.get(self._name, 0) * 1e-9
                agent.answered = max(agent.answered, min(answered, now))
        if new:
            # It joined later, so it has not heard this one; and its link may be new.
            self._next_beat = self._next_find = now
            self._wake.set()
            self._met(name)
        elif back:
            self._report(Change(name, agent.machine, seen=True, last=False))

    def _on_link(self, _event: zenoh.LinkEvent) -> None:
        """Have the connections found at once."""
        self._next_find = 0.0
        self._wake.set()

    def _part(self, subsystem: str, name: str) -> None:
        """Forget an agent with which this one has no group any more."""
        if (agent := self._agents.get(name)) is not None:
            agent.groups.discard(subsystem)
            if not agent.groups:
                del self._agents[name]

    def _work(self) -> None:
        process_setup.go_before_others()
        pause = 0.0
        while not self._over:
            self._wake.wait(pause)
            self._wake.clear()
            now, pause = time.monotonic(), PERIOD
            try:
                pause = self._turn(now)
            except Exception:  # a fault in one turn must not end the signs of life
                log.exception("the links could not be checked")

    def _turn(self, now: float) -> float:
        """Do what is due; return the seconds until the links want care again."""
        if now >= self._next_find:
            self._next_find = now + FIND_PERIOD
            self._find()
        pause = self._retransmission.tend()
        if pause >= IDLE and not self.is_needed():
            pause = max(pause, SELDOM)
        pause = min(pause, self._next_find - now)
        if not self._groups:
            return max(LEAST, pause)
        if now >= self._next_beat:
            self._next_beat = now + PERIOD
            self._leave_those_over(now)
            beat = self._beat()
            for group in list(self._groups.values()):
                group.put(beat)
        self._check(now)
        pause = min(pause, self._next_beat - now, self._until_silent(now))
        return max(LEAST, pause)

    def _find(self) -> None:
        """Find the connections, and whether others' messages go through this agent."""
        self._retransmission.find()
        with contextlib.suppress(zenoh.ZError):
            self._passes_on = len(self._session.info.links()) > 1

    def _leave_those_over(self, now: float) -> None:
        """Leave the groups of tables that the RTPU has not had for `LINGER`."""
        for subsystem, group in list(self._groups.items()):
            with self._joining:  # it is joined again after the last sign, or not left
                if group.left is not None and now - group.left > LINGER:
                    with self._guard:
                        del self._groups[subsystem]
                        for name in list(self._agents):
                            self._part(subsystem, name)
                    group.close()
                    self._say_goodbye(subsystem, now)

    def _say_goodbye(self, subsystem: str, now: float) -> None:
        """Give the last sign of life in a group, after those before it."""
        goodbye = Beat(self._machine, round(now * 1e9), {}, leaves=True)
        with contextlib.suppress(zenoh.ZError):
            self._session.put(  # pyright: ignore[reportUnknownMemberType]
                key_expressions.beat(self._domain, subsystem, self._name),
                self._encoder.encode(goodbye),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.REAL_TIME,
            )

    def _beat(self) -> bytes:
        """Return a packed sign of life."""
        with self._guard:
            seen = [(name, one) for name, one in self._agents.items() if one.seen]
        held = {one.machine: self._holds(one.machine) for _, one in seen}
        heard = {name: HELD if held[one.machine] else one.sent_ns for name, one in seen}
        beat = Beat(self._machine, round(time.monotonic() * 1e9), heard)
        return self._encoder.encode(beat)

    def _until_silent(self, now: float) -> float:
        """Return the seconds after which an agent may be out of sight next."""
        heard = (one.heard for one in list(self._agents.values()) if one.seen)
        left = min(heard, default=now) + session.SILENT_MS * 1e-3 - now
        return max(left, LEAST)

    def _check(self, now: float) -> None:
        """Report agents that went out of sight."""
        before = now - session.SILENT_MS * 1e-3
        for name, agent in list(self._agents.items()):
            if agent.heard > before:
                continue
            with self._guard:
                gone = agent.seen and agent.heard <= before
                agent.seen = agent.seen and not gone
                last = not any(
                    one.seen and one.machine == agent.machine
                    for one in self._agents.values()
                )
                here = agent.machine == self._machine  # see `silence`
                if last and not here and agent.heard < now - FORGET:
                    self._agents.pop(name, None)
            if gone:
                self._report(Change(name, agent.machine, seen=False, last=last))
