"""One table of this machine, and its exchange with other machines.

Its work is done in the carrier's thread, and zenoh's threads only pass on data. Single
values are sent and taken by these, while the carrier's does nothing.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeVar

import zenoh

from pbonet.errors import Severity
from pbonet.node.rtpu import lock_to_carry, remove_unused, table_name
from pbonet.node.wire import rtpu_messages
from pbonet.svar import Table
from pbonet.svar.mirror import Mirror, packets
from pbonet.xm.net import VALUES_PRIORITY, direct, key_expressions

from . import remote_handover
from .packet_queue import PacketQueue
from .sent_value import TAKEN, VALUE, SentValue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pbonet.svar import Watch
    from pbonet.xm.net import Call, Declared

log = logging.getLogger("pbonet.node")

T = TypeVar("T")
SHORTEST, LONGEST = 0.00015, 0.025
"""Limits of the seconds between reads of a table, which depend on how often it changes.
A read costs tens of microseconds, so commits close to each other are sent together."""
NEVER = 1e9
"""A duration that is never over, in seconds."""
UNHEARD = 0.2
"""Seconds between reads if no other machine receives."""
BEAT = 0.5
"""Seconds after which everything is sent again, in case a packet was dropped."""
SILENT = 1.6
"""Seconds of silence after which a machine is unreachable."""
FLAG = 0.02
"""Seconds between checks of the causes of the flag."""
ANSWER_TIME = 0.5
"""Seconds that another machine has to process a state."""
TAKE = b"take"
"""Asks the agent that carries a table to process the other machines' states, too."""
TOLD_NS = 10_000_000_000
"""Nanoseconds between two reports about lost packets."""


class Owner(Protocol):
    """The thread that does the work; see `TableCarrier`."""

    session: zenoh.Session
    domain: str
    machine: str
    tell: Callable[[rtpu_messages.Note], None]
    refuses: Callable[[str, str], bool]
    """Whether a subsystem's packets from a machine are not to be used."""
    speaks: Callable[[], int]
    """Returns the version of packets that all other machines understand."""
    silence: Callable[[str], float]
    """Returns for how many seconds an RTPU's machine has not answered signs of life."""

    def do(self, what: Callable[[], object]) -> None:
        """Let the carrier's thread call a function; may be called from any thread."""

    def offer(self, what: Callable[[], object]) -> bool:
        """As `do` unless too much waits; return whether it will be called."""
        ...

    def at_once(self, what: Callable[[], T]) -> T | None:
        """Call a function in this thread; None if it fails or the carrier's is busy."""
        ...

    def end(self, done: Callable[[], None]) -> None:
        """Let a separate thread call `done`; for use in zenoh's threads."""

    def late(self, machine: str, sent_ns: int) -> int | None:
        """Return the transmission time of a packet in nanoseconds; None: unknown."""
        ...

    def measured(self, machine: str, begin_ns: int, end_ns: int, sent_ns: int) -> None:
        """Use an exchange of states as a measurement of that machine's clock."""

    def safely(self, what: Callable[[], object]) -> None:
        """Call a function, and log its exception."""


class MirroredTable:
    """One table of this machine, which this agent carries.

    Args:
        owner: The owner of the thread that does the work.
        subsystem: The subsystem of the table.
        use: How this agent's RTPU uses the table.
    """

    def __init__(
        self, owner: Owner, subsystem: str, use: rtpu_messages.OpenTable
    ) -> None:
        self._owner = owner
        self.subsystem = subsystem
        self.table = Table.attach(table_name(owner.domain, subsystem))
        self._use = use
        self._used = time.monotonic()
        self.mirror: Mirror | None = None
        self.next = 0.0
        self._keeper_due = 0.0
        """When the loss of the keeper's machine is checked again."""
        self.changed = False
        """Whether commands have changed it while there was no other machine."""
        self.incoming = PacketQueue(lambda: owner.do(self._take_waiting))
        self._beat = self._flag = 0.0
        self._lost, self._told_ns = 0, -TOLD_NS
        self._there: set[str] = set()
        self._settled = False
        self._declared: list[Declared] = []
        self._publisher: zenoh.Publisher | None = None
        self._lock = -1

    @property
    def alone(self) -> bool:
        """Whether there is no other machine; a later one will ask for the state."""
        mirror = self.mirror  # read once: the carrier's thread may end it meanwhile
        if mirror is None or not self._settled:
            return False
        return not (self._there or mirror.others)

    def use(self, use: rtpu_messages.OpenTable) -> None:
        """Change how the table is used."""
        if use != self._use:
            self._use, self._used = use, time.monotonic()
            self.next = self._keeper_due = 0.0

    def turn(self, now: float) -> None:
        """Do what is due, and set the time of the next turn."""
        self._transfer(now)
        if self.mirror is not None:
            if now >= self._keeper_due:
                self._check_keeper(self.mirror, now)
            self.next = min(self.next, self._keeper_due)

    def _transfer(self, now: float) -> None:
        """Send what is new to the other machines, and miss the silent ones."""
        if self.mirror is None and not self._begin():
            self.next = now + UNHEARD
            return
        mirror = self.mirror
        if mirror is not None:
            mirror.miss(SILENT)
        if mirror is None or not self._has_receivers():
            self.next = now + UNHEARD
            if self.changed:
                self.changed = False
                self._exchange()
            return
        look = now >= self._flag
        if look:
            self._flag = now + FLAG
        packet = mirror.next_packet(full=now >= self._beat, look=look)
        if packet is not None:
            self._put(packet, now)
        self._pace(now)

    def _check_keeper(self, mirror: Mirror, now: float) -> None:
        """Raise or clear the flag for the loss of the keeper's machine."""
        keeper, alone = self._use.keeper, self._use.alone
        loss, left = "", NEVER
        if keeper and alone:
            left = alone - min(self._owner.silence(keeper), now - self._used)
            if left <= 0:
                loss = f"no sign of life from RTPU {keeper} for {alone:g} s (ALONE)"
                left = UNHEARD
        self._keeper_due = now + left
        before = mirror.loss_of_keeper
        if loss != before:
            mirror.loss_of_keeper = loss
            severity, code, text = (
                (Severity.WARNING, "ILLEGAL", loss)
                if loss
                else (Severity.INFO, "LEGAL", f"no longer: {before}")
            )
            self._owner.tell(
                rtpu_messages.Note(int(severity), code, f"{self.subsystem}: {text}")
            )

    def watch(self, watch: Watch) -> None:
        """End the carrier's sleep when there is something to send to others."""
        if self.mirror is not None and self._has_receivers():
            self.mirror.watch(watch)

    def _has_receivers(self) -> bool:
        """Return whether another machine has the table, if only by a link that is kept.

        Values for a machine that is out of sight reach it as soon as the link
        continues, before that machine can be heard.
        """
        return bool(self._there or (self.mirror and self.mirror.others))

    def spread(self, done: Callable[[], None], *, take: bool) -> None:
        """Send the whole state to the other machines, then call `done`.

        With `take`, it is called after all their answers have been processed.
        """
        if self.mirror is not None or self._begin():
            self._exchange(partial(self._owner.do, done) if take else done)
        else:  # another agent of this machine carries it
            self._get("flush", self._owner.machine, TAKE if take else b"", done)

    def send_value(
        self, name: str, done: Callable[[], None], whole: Callable[[], None]
    ) -> bool:
        """Send a variable that was set here, and call `done` when the others have it.

        If one of them needs the whole state, `whole` is called in its place. Runs in
        any thread. Returns whether the value was sent; else the state must be.
        """
        found = self._owner.at_once(partial(self._value, name))
        if found is None:
            return False
        packet, machines = found
        ended = partial(self._owner.end, done)
        sent = SentValue(machines, done, whole, ended)
        data = packets.pack(packet)
        self._ask("sync", "*", data, sent.replied, sent.end, value=True)
        return True

    def _value(self, name: str) -> tuple[packets.Packet, set[str]] | None:
        """Return the packet with a value, and the machines that are to take it."""
        if self.mirror is None or (packet := self.mirror.value_packet(name)) is None:
            return None
        return packet, {*self._there, *self.mirror.others}

    def lose(self, machine: str) -> None:
        """Drop a machine that is out of sight, whether or not its link is kept."""
        if self.mirror is not None:
            self.mirror.lose(machine)

    def meet(self) -> None:
        """Exchange states with a machine that is in sight again."""
        if self.mirror is not None:
            self.next = self._keeper_due = 0.0  # it may be the keeper's
            self._exchange()

    def call(self, calls: Sequence[Call]) -> None:
        """Send the whole state to the other machines, with calls of successors.

        If another agent of this machine carries the table, no call is made; see
        `remote_handover`.
        """
        if self.mirror is not None:
            self._exchange(calls=remote_handover.packed(calls))

    def close(self) -> None:
        """Detach from the table, and remove it if it has no other users."""
        for entity in self._declared:
            with contextlib.suppress(zenoh.ZError):
                entity.undeclare()
        if self.mirror is not None:
            self.mirror.close()
        if self._lock >= 0:
            os.close(self._lock)
        path = self.table.path
        self.table.close()
        self.mirror = None
        remove_unused(path)

    def _begin(self) -> bool:
        """Take the machine's part, unless another agent has it."""
        self._lock = lock_to_carry(self.table.path)
        if self._lock < 0:
            return False
        owner = self._owner
        self.mirror = Mirror(
            self.table,
            owner.machine,
            int.from_bytes(os.urandom(8)) >> 2,
            keep=self._use.keep,
            late=owner.late,
            speaks=owner.speaks,
        )
        session, key = (
            owner.session,
            partial(key_expressions.svar, owner.domain, self.subsystem),
        )
        self._publisher = session.declare_publisher(
            key("news", owner.machine),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=VALUES_PRIORITY,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        self._declared += [
            self._publisher,
            session.declare_subscriber(
                key("news"),
                direct(self._on_packet),
                allowed_origin=zenoh.Locality.REMOTE,
            ),
            session.declare_queryable(
                key("sync", owner.machine), direct(self._asked), complete=True
            ),
            session.declare_queryable(
                key("flush", owner.machine), direct(self._flushed), complete=True
            ),
            session.liveliness().declare_subscriber(
                key("here"), direct(self._met), history=True
            ),
            session.liveliness().declare_token(key("here", owner.machine)),
        ]
        self._exchange(partial(self._owner.do, self._settle))
        return True

    def _settle(self) -> None:
        self._settled = True

    def _put(self, packet: packets.Packet, now: float) -> None:
        if packet.full is not None:
            self._beat = now + BEAT
        if self._publisher is not None:
            with contextlib.suppress(zenoh.ZError):
                self._publisher.put(packets.pack(packet))  # pyright: ignore[reportUnknownMemberType]

    def _pace(self, now: float) -> None:
        """Set the next read just after the next commit, by the writers' periods."""
        due = self.mirror.due() if self.mirror is not None else None
        if due is None:
            self.next = self._beat
        else:  # an overdue commit is checked at doubling intervals
            self.next = now + min(max(abs(due), SHORTEST), LONGEST)

    # -- zenoh's threads ---------------------------------------------------------------

    def _on_packet(self, sample: zenoh.Sample) -> None:
        machine = key_expressions.last(str(sample.key_expr))
        self.incoming.put(machine, sample.payload.to_bytes())

    def _met(self, sample: zenoh.Sample) -> None:
        machine = key_expressions.last(str(sample.key_expr))
        if machine == self._owner.machine:
            return
        if sample.kind == zenoh.SampleKind.PUT:
            self._there.add(machine)
            self._owner.do(self._exchange)
        else:
            self._there.discard(machine)
            self._owner.do(lambda: self.lose(machine))

    def _asked(self, query: zenoh.Query) -> None:
        attached, answer = query.attachment, self._answer
        if attached is not None and attached.to_bytes() == VALUE:
            taken = self._owner.at_once(partial(self._take_value, query))
            if taken is not None:
                self._reply(query, taken)
                return
            answer = self._answer_value
        if not self._owner.offer(partial(answer, query)):
            query.drop()  # type: ignore[no-untyped-call]

    def _flushed(self, query: zenoh.Query) -> None:
        def done() -> None:
            with contextlib.suppress(zenoh.ZError), query:
                query.reply(str(query.key_expr), b"")  # pyright: ignore[reportUnknownMemberType]

        take = query.payload is not None and query.payload.to_bytes() == TAKE
        if not self._owner.offer(lambda: self.spread(done, take=take)):
            query.drop()  # type: ignore[no-untyped-call]

    # -- the carrier's thread ----------------------------------------------------------

    def _take_waiting(self) -> None:
        """Process the packets that wait; old values among them are not written."""
        waiting = [(data, packets.unpack(data)) for data in self.incoming.taken()]
        packets.leave_newest([packet for _, packet in waiting if packet is not None])
        for data, packet in waiting:
            self._owner.safely(partial(self._take_read, data, packet))
        lost, now = self.incoming.lost.total(), time.monotonic_ns()
        if lost > self._lost and now - self._told_ns > TOLD_NS:
            self._owner.tell(
                rtpu_messages.Note(
                    int(Severity.WARNING),
                    "TABLE_BEHIND",
                    f"{lost - self._lost} packets for the table of {self.subsystem} "
                    "were lost: they came faster than they could be processed",
                )
            )
            self._lost, self._told_ns = lost, now

    def _take(self, data: bytes, asked: tuple[int, int] | None = None) -> str:
        """Process another machine's packet; return that machine.

        Args:
            data: The packet.
            asked: When it was asked for, and when it came, if it is an answer.
        """
        return self._take_read(data, packets.unpack(data), asked)

    def _take_read(
        self,
        data: bytes,
        read: packets.Packet | None,
        asked: tuple[int, int] | None = None,
    ) -> str:
        """Process a packet after `packets.unpack`; return its machine."""
        packet = self._usable(data, read)
        if packet is None:
            return ""
        self._place(packet, asked)
        return packet.machine

    def _answer_value(self, query: zenoh.Query) -> None:
        self._reply(query, self._take_value(query))

    def _take_value(self, query: zenoh.Query) -> bytes:
        """Process another machine's single value; return the answer to it."""
        data = query.payload.to_bytes() if query.payload is not None else b""
        packet, mirror = self._usable(data, packets.unpack(data)), self.mirror
        if packet is None or mirror is None:
            return b""
        return TAKEN if self._place(packet) and mirror.has(packet) else b""

    def _usable(
        self, data: bytes, packet: packets.Packet | None
    ) -> packets.Packet | None:
        """Return another machine's packet, unless it is not to be used here."""
        if self.mirror is None:
            return None
        if packet is None:
            if (head := packets.other_version(data)) is not None:
                self.mirror.refuse(head)
            return None
        if packet.machine == self._owner.machine:
            return None
        return None if self._owner.refuses(self.subsystem, packet.machine) else packet

    def _place(
        self, packet: packets.Packet, asked: tuple[int, int] | None = None
    ) -> bool:
        """Write a packet to the table; return whether its values were understood."""
        mirror = self.mirror
        if mirror is None:
            return False
        if asked is not None:
            self._owner.measured(packet.machine, *asked, packet.sent_ns)
        new = packet.machine not in mirror.others
        placed = mirror.take(packet)
        late_ns = self._owner.late(packet.machine, packet.sent_ns)
        for call in packet.calls:
            remote_handover.make(self.table, call, late_ns)
        if new or (not placed and packet.full is None):
            self.next = 0.0
            self._beat = 0.0  # it may lack our state, too
        return placed

    def _answer(self, query: zenoh.Query) -> None:
        """Process the state of the asking machine, and return this machine's."""
        if self.mirror is None:
            query.drop()  # type: ignore[no-untyped-call]
            return
        asker = ""
        if query.payload is not None:
            asker = self._take(query.payload.to_bytes())
        packet = self.mirror.next_packet(full=True, machine=asker)
        self.next = 0.0  # the others may lack what the asker is sent
        self._reply(query, packets.pack(packet) if packet is not None else b"")

    def _reply(self, query: zenoh.Query, data: bytes) -> None:
        key = key_expressions.svar(
            self._owner.domain, self.subsystem, "sync", self._owner.machine
        )
        with contextlib.suppress(zenoh.ZError), query:
            query.reply(key, data)  # pyright: ignore[reportUnknownMemberType]

    def _exchange(
        self, done: Callable[[], None] | None = None, calls: Sequence[bytes] = ()
    ) -> None:
        """Send this machine's state to all others, and process theirs."""
        packet = self.mirror.next_packet(full=True) if self.mirror is not None else None
        if packet is not None:
            packet.calls = list(calls)
        self._get("sync", "*", packets.pack(packet) if packet else b"", done)

    def _get(
        self, leaf: str, machine: str, data: bytes, done: Callable[[], None] | None
    ) -> None:
        owner, begin_ns = self._owner, time.monotonic_ns()

        def replied(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answer, now_ns = reply.ok.payload.to_bytes(), time.monotonic_ns()
                owner.offer(lambda: self._take(answer, (begin_ns, now_ns)))

        self._ask(leaf, machine, data, replied, done and partial(owner.end, done))

    def _ask(
        self,
        leaf: str,
        machine: str,
        data: bytes,
        replied: Callable[[zenoh.Reply], None],
        end: Callable[[], None] | None,
        *,
        value: bool = False,
    ) -> None:
        """Ask other machines; `replied` and `end` are called by zenoh's threads.

        With a `value`, it is one of these threads that asks, and it must not wait.
        """
        drop, block = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
        try:
            self._owner.session.get(
                key_expressions.svar(self._owner.domain, self.subsystem, leaf, machine),
                direct(replied, end),
                payload=data,
                attachment=VALUE if value else None,
                congestion_control=drop if value else block,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWER_TIME,
                allowed_destination=(
                    zenoh.Locality.REMOTE if leaf == "sync" else zenoh.Locality.ANY
                ),
            )
        except zenoh.ZError as error:
            log.debug("%s: no machine could be asked: %s", self.subsystem, error)
            if end is not None:
                end()
