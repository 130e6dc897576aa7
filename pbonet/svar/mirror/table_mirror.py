"""A machine's part in a table that exists on several (DESIGN: across machines).

It reports to the others the groups that tasks here write, and writes theirs to this
machine's table, as commits with their true age. Its caller decides when, and over which
network; one thread calls it at a time.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import TYPE_CHECKING

from pbonet.errors import SvarError, UnknownVariableError
from pbonet.svar import now_ns

from . import packets
from .epochs import HERE, Epochs
from .mirror_inbox import Machine
from .mirror_outbox import Outbox

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.svar import Table, Watch

    from .packets import Head, Packet

RAISER = "mirror"
"""Raiser of the flag when machines are unreachable, or claim the same variable."""


class Mirror:
    """One table of one machine.

    Args:
        table: The table.
        machine: This machine's identity.
        run: A number that no other start has.
        keep: Whether operators set variables on this machine.
        late: Returns the transmission time of a packet in ns, by machine and sending
            time; None if it is not known: its values count as old then.
    """

    def __init__(
        self,
        table: Table,
        machine: str,
        run: int,
        *,
        keep: bool,
        late: Callable[[str, int], int | None] = lambda _machine, _sent: 0,
        speaks: Callable[[], int] = lambda: packets.VERSIONS.newest,
    ) -> None:
        self.table = table
        self.machine, self.run = machine, run
        self.host = socket.gethostname()
        self.others: dict[str, Machine] = {}
        self._newcomers: set[str] = set()
        """Machines that have not received this table's content yet."""
        self._late, self._speaks = late, speaks
        self._epochs = Epochs()
        self._outbox = Outbox(table, keep=keep)
        self._state = 0
        self._fights: list[int] = []
        self._news = False
        """Whether there is something to send that is not in the table."""
        self._raised: dict[tuple[str, str, str], None] = {}
        self._causes: list[tuple[str, str]] = []
        self._glance = table.local(RAISER, os.getpid())
        """Checks with one load whether the flag is up."""
        self._changes = 0
        """The flag's change count at the last check."""
        self._lost: dict[str, tuple[str, list[int]]] = {}
        self._loss_of_keeper = ""
        self._unread: dict[str, tuple[str, int]] = {}
        """By the cause, machines whose packets cannot be read, and when one came."""

    def next_packet(
        self, *, full: bool = False, look: bool = True, machine: str = ""
    ) -> Packet | None:
        """Return the packet to send; None if nothing is new.

        Args:
            full: Send everything, not only what is new.
            look: Whether to check the causes of the flag, too.
            machine: The only receiver; all by default.
        """
        changed = self._outbox.update(self._epochs)
        if changed:
            self._reconcile()
        if look and self._read_causes():
            changed = True
        changed, self._news = changed or self._news, False
        self._news = changed and bool(machine)  # the others are still to be notified
        if changed:
            self._state += 1
        full = full or changed
        comes = self._newcomers & {machine} if machine else self._newcomers
        news = self._outbox.news(
            now_ns(), everything=full, newest=full and bool(comes), to_all=not machine
        )
        if not (full or news):
            return None
        if full:
            self._newcomers = self._newcomers - comes
        return self._packet(news, self._full() if full else None)

    def value_packet(self, variable: str) -> Packet | None:
        """Return a packet with one variable that an operator has set here.

        None if the others must be sent the whole state to understand it.
        """
        if self._news:
            return None
        try:
            number = self.table.index(variable)
        except UnknownVariableError:  # it was refused
            return None
        news = self._outbox.set_value(number, now_ns())
        return None if news is None else self._packet([news])

    def _packet(
        self, news: list[packets.News], full: packets.Full | None = None
    ) -> Packet:
        return packets.Packet(
            self._speaks(),
            self.machine,
            self.host,
            self.run,
            self._state,
            now_ns(),
            news,
            full,
        )

    def take(self, packet: Packet) -> bool:
        """Process another machine's packet.

        Returns:
            Whether its news belong to known groups; else that machine must be asked for
            its whole state.
        """
        other = self.others.get(packet.machine)
        if other is not None and other.run != packet.run:
            self._remove(packet.machine)
            other = None
        if other is None:
            other = self.others[packet.machine] = Machine(
                self.table, packet.run, packet.host
            )
            self._newcomers.add(packet.machine)
        if self._unread:
            self._keep_unread(lambda machine, _: machine != packet.machine)
        late = self._late(packet.machine, packet.sent_ns)
        if packet.state < other.state:
            packet.full = None  # it was overtaken by a newer one
        placed = other.take(packet, late)
        if packet.full is not None:
            self._lost.pop(packet.machine, None)
            self._epochs.there(
                packet.machine, other.claims(), packet.full.ended, packet.full.fights
            )
            self._news |= self._outbox.update(self._epochs)
            self._reconcile()
            # Else a value that is set now would pass for one from before their claim.
            self._news |= self._outbox.update(self._epochs)
        return placed

    def has(self, packet: Packet) -> bool:
        """Return whether the table has the values of a packet that was taken.

        It has not if the other machine has yet to hear of a claim that counts here.
        """
        other = self.others[packet.machine]
        return all(map(other.has, packet.news))

    def miss(self, seconds: float) -> None:
        """Drop the machines that have sent nothing for so many seconds."""
        before = now_ns() - round(seconds * 1e9)
        silent = [m for m, other in self.others.items() if other.heard_ns < before]
        for machine in silent:
            self.lose(machine)
        if self._unread:
            self._keep_unread(lambda _, heard_ns: heard_ns >= before)

    def refuse(self, head: Head) -> None:
        """Raise the flag for a machine whose packets are of another version."""
        text = (
            f"the table of host {head.host[:40]} is of version {head.v}, here "
            f"{packets.VERSIONS}: no values are exchanged"
        )[:120]
        new = text not in self._unread
        self._unread[text] = head.machine, now_ns()
        if new:
            self._reconcile()

    def _keep_unread(self, keep: Callable[[str, int], bool]) -> None:
        kept = {text: one for text, one in self._unread.items() if keep(*one)}
        if kept != self._unread:
            self._unread = kept
            self._reconcile()

    def lose(self, machine: str) -> None:
        """Drop a machine that is unreachable."""
        other = self.others.get(machine)
        if other is None:
            return
        # Still there if only a late packet has come meanwhile, without its groups.
        self._lost.setdefault(machine, (other.host, other.owned()))
        self._remove(machine)
        self._reconcile()

    @property
    def loss_of_keeper(self) -> str:
        """Why the keeper's machine counts as lost; empty: it does not.

        The flag is raised for it here. Other machines judge for themselves.
        """
        return self._loss_of_keeper

    @loss_of_keeper.setter
    def loss_of_keeper(self, loss: str) -> None:
        self._loss_of_keeper = loss
        self._reconcile()

    def close(self) -> None:
        """Release what is in the table for others, and clear what was raised."""
        for machine in list(self.others):
            self._remove(machine)
        self._lost.clear()
        self._raise_exactly({})

    def due(self) -> float | None:
        """Return in how many seconds a commit is expected; below 0: it is overdue."""
        now = now_ns()
        expected = self._outbox.due(now)
        return None if expected is None else (expected - now) * 1e-9

    def watch(self, watch: Watch) -> None:
        """End a sleep when there is something to send that `due` does not expect."""
        heads = self._outbox.heads(now_ns())
        generation = max(self._outbox.generation, 0)
        watch.add(self._glance.arena, generation, self._changes, heads)

    def conflicts(self) -> list[str]:
        """Return the variables that are owned on two machines."""
        names = self._epochs.fought_over(self._fights)
        return [self.table.variables[v].name for v in sorted(names)]

    def _remove(self, machine: str) -> None:
        self.others.pop(machine).drop()
        self._newcomers.discard(machine)
        self._epochs.forget(machine)

    def _full(self) -> packets.Full:
        return packets.Full(
            groups=self._outbox.groups_to_send(self._epochs),
            ended=list(self._epochs.ended.items()),
            fights=self._fights,
            causes=self._causes,
        )

    def _reconcile(self) -> None:
        """Write the valid values to the table, and raise the flag for conflicts."""
        fights = self._epochs.own_fights(self._is_constant)
        if fights != self._fights:
            self._fights, self._news = fights, True
        fought = self._epochs.fought_over(fights)
        for machine, other in self.others.items():
            other.show({
                v
                for v in other.claims()
                if v not in fought and self._epochs.winner(v) == machine
            })
        self._raise_exactly(self._wanted_causes(fought))

    def _wanted_causes(self, fought: set[int]) -> dict[tuple[str, str, str], None]:
        """Return the causes to raise here for other machines, and for their loss."""
        wanted: dict[tuple[str, str, str], None] = {}
        for other in self.others.values():
            for cause, raiser in other.causes:
                wanted[cause, raiser, other.host] = None
        for text in self._unread:
            wanted[text, RAISER, self.host] = None
        if self._loss_of_keeper:
            wanted[self._loss_of_keeper, RAISER, self.host] = None
        names = self.table.variables
        for number in sorted(fought):
            text = f"{names[number].name} is written on two machines"
            wanted[text, RAISER, self.host] = None
        for host, owned in self._lost.values():
            free = [names[v].name for v in owned if self._is_free(v)]
            if free:
                text = f"host {host} is unreachable; no task writes {' '.join(free)}"
                wanted[text[:120], RAISER, self.host] = None
        return wanted

    def _is_free(self, variable: int) -> bool:
        return self._epochs.winner(variable) is None or not any(
            claim.live
            for known in (self._epochs.own, *self._epochs.others.values())
            if (claim := known.get(variable)) is not None
        )

    def _raise_exactly(self, wanted: dict[tuple[str, str, str], None]) -> None:
        for cause in self._raised.keys() - wanted.keys():
            text, raiser, host = cause
            with contextlib.suppress(SvarError):
                self.table.clear_illegal(raiser, text, host)
            del self._raised[cause]
        for cause in wanted:
            if cause not in self._raised:
                with contextlib.suppress(SvarError):
                    self.table.raise_illegal(*cause)
                    self._raised[cause] = None

    def _read_causes(self) -> bool:
        """Read the causes raised on this machine; return whether they have changed."""
        self._changes = self._glance.arena.changes
        standing = self.table.illegal if self._glance.illegal else []
        causes = [
            (one.cause, one.raiser)
            for one in standing
            if (one.cause, one.raiser, one.machine) not in self._raised
        ]
        if causes == self._causes:
            return False
        self._causes = causes
        return True

    def _is_constant(self, variable: int, machine: str) -> bool:
        """Return whether a variable is a constant with the same value on both machines.

        A constant is written once, by a commit of cycle 0.
        """
        info = self.table.info(variable)
        other = self.others.get(machine)
        if other is None or info.cycle:
            return False
        here = self.table.seen(variable)[0].tobytes()
        for theirs in other.groups.values():
            if variable in theirs.group.vars and theirs.news is not None:
                same = theirs.value(self.table, variable)
                return not theirs.news.cycle and same == here
        return False


__all__ = ["HERE", "RAISER", "Mirror"]
