"""Stop orders that other RTPUs have not carried out yet, and their repetition.

A stop is in force for every RTPU that had the subsystem when it was given. An agent
knows these from the greetings of the other agents. If one of them was out of reach, it
gets the order as soon as it is seen again; until it has carried it out, nothing that
its machine sends for the subsystem's table is used. Every agent that has received the
stop does this, so it needs neither the master nor the command that gave it. Of links
with that machine no record is used, and no message or semaphore passes between it and
tasks of the subsystem elsewhere. An RTPU
carries an order out once, so it does not matter how often it arrives. With keys, other
machines take the repetition from a gateway only (see `pbonet.xm.net.access_control`).

An RTPU process that is new is concerned too: its agent may spawn the tasks again that
were lost with the former one. So that agent asks for the orders first
(`AgentInfo.due`), and they outlive the agent, see `pbonet.node.restart`.

The same holds for an order to turn tasks OFF in whose place others are now. It concerns
the RTPUs that it names, also new processes of them, which may have such a task again.
"""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

from msgspec import Struct

from pbonet.errors import AccessError, PbonetError, Severity, UnreachableError
from pbonet.node.restart import StopLeft
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import key_expressions, messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

log = logging.getLogger("pbonet.node")

MOST: Final = 64
"""Orders that are remembered after they were carried out; the oldest are forgotten."""
TIME: Final = 2.0
"""Seconds that an RTPU gets for turning its tasks off."""
PATIENCE: Final = 4.0
"""Seconds in which an RTPU that is seen all the time must have carried an order out; it
has received it from the master, too."""


Order: TypeAlias = m.Stop | m.Replaced


class Caller(Protocol):
    """Sends a request to an RTPU, such as `pbonet.xm.net.Client`."""

    def call(
        self,
        rtpu: str,
        request: Order,
        result: type[m.Stopped],
        *,
        timeout: float,
    ) -> m.Stopped:
        """Return the result; raises a `PbonetError`."""
        ...


class Listener(Protocol):
    """Learns of other agents, as `StopOrders`."""

    def met(self, info: m.AgentInfo) -> None:
        """Take an agent's greeting."""

    def lost(self, name: str) -> None:
        """Take in that an agent is not seen any more."""

    def ended(self, name: str) -> None:
        """Take in that an agent has ended in order."""

    def dropped(self, name: str) -> None:
        """Forget an agent that is there, and is not asked any more."""


class _Peer(Struct):
    """An RTPU, as its agent described it last."""

    subsystems: list[str]
    """Subsystems of its RTPU process, or of the last one, which may come back."""
    machine: str
    """In the form used in keys."""
    here: set[str]
    """RTPUs of its machine that have a process."""
    ended: set[str]
    """RTPUs of its machine that had one, and have none any more."""


class _Order(Struct):
    id: str
    subsystem: str
    """Empty: every subsystem."""
    at: float
    """When it was received (monotonic)."""
    due: dict[str, float]
    """RTPUs that have not carried it out, and from when on it is repeated there."""
    machines: dict[str, str]
    """Their machines, of which nothing is used; see `StopOrders.met`."""
    sent: set[str]
    """RTPUs to which it is being sent."""
    tasks: dict[str, list[str]]
    """Tasks to be turned OFF, by RTPU; empty: all tasks are ended."""


class StopOrders:
    """The stop orders that an agent has received.

    Args:
        name: The agent's RTPU.
        client: Sends requests to other RTPUs.
        note: Called with reports for masters.
        before: The orders of the agent before this one.
        changed: Called when `left` has changed.
    """

    def __init__(
        self,
        name: str,
        client: Caller,
        note: Callable[[rtpu_messages.Note], None],
        before: Iterable[StopLeft] = (),
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._name, self._client, self._note = name, client, note
        self._changed = changed
        self._peers: dict[str, _Peer] = {}
        now = time.monotonic()
        self._orders = [
            _Order(
                id=one.id,
                subsystem=one.subsystem,
                at=now,
                due=dict.fromkeys(one.due, 0.0),
                machines=one.machines,
                sent=set(),
                tasks=one.tasks,
            )
            for one in before
        ]
        self._gone = {name for order in self._orders for name in order.due}
        """RTPUs that are not seen now."""
        self._guard = threading.Lock()
        self._pool = ThreadPoolExecutor(4, "pbonet stops")

    def stop(self) -> None:
        """Repeat no order any longer."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def add(self, request: Order) -> None:
        """Take an order that this agent's RTPU was given.

        One without an identity is not repeated: whether it was carried out cannot be
        seen.
        """
        now = time.monotonic()
        with self._guard:
            known = any(order.id == request.stop_id for order in self._orders)
            if known or not request.stop_id:
                return
            tasks = request.tasks if isinstance(request, m.Replaced) else {}
            concerned = [name for name in tasks if name != self._name] or [
                name
                for name, peer in self._peers.items()
                if not tasks and _concerns(request.subsystem, peer.subsystems)
            ]
            there = self._peers.keys() - self._gone
            later = now + request.timeout + PATIENCE
            order = _Order(
                id=request.stop_id,
                subsystem=request.subsystem,
                at=now,
                due={name: later if name in there else 0.0 for name in concerned},
                machines={
                    name: self._peers[name].machine
                    for name in concerned
                    if name in self._peers
                },
                sent=set(),
                tasks=tasks,
            )
            self._orders = [*self._remembered(order), order]
        self._changed()

    def _remembered(self, new: _Order) -> list[_Order]:
        """Return the orders to remember beside a new one, which may contain others."""
        for one in self._orders:
            if not new.tasks and new.subsystem in {"", one.subsystem}:
                for name in one.due.keys() & new.due.keys():
                    new.due[name] = min(new.due[name], one.due.pop(name))
        done = [one for one in self._orders if not one.due]
        forgotten = done[: max(0, len(done) - MOST)]
        return [one for one in self._orders if one not in forgotten]

    def left(self) -> list[StopLeft]:
        """Return the orders that RTPUs which were out of reach have not carried out."""
        with self._guard:
            found = [
                StopLeft(
                    id=order.id,
                    subsystem=order.subsystem,
                    due=[name for name, due in order.due.items() if not due],
                    machines=order.machines,
                    tasks=order.tasks,
                )
                for order in self._orders
            ]
        return [order for order in found if order.due]

    def due(self) -> dict[str, list[tuple[str, str]]]:
        """Return the stops not carried out yet by RTPU: id and subsystem.

        Also at RTPUs that are seen: what the stop ends elsewhere is no loss for them.
        """
        found: dict[str, list[tuple[str, str]]] = {}
        with self._guard:
            for order in self._orders:
                for name in order.due if not order.tasks else ():
                    found.setdefault(name, []).append((order.id, order.subsystem))
        return found

    def others(self, subsystem: str) -> list[str]:
        """Return the other RTPUs that a subsystem uses, as their agents said last."""
        with self._guard:
            return [n for n, one in self._peers.items() if subsystem in one.subsystems]

    def met(self, info: m.AgentInfo) -> None:
        """Compare another agent's greeting with the orders, and repeat what is due.

        Of an RTPU that has no process any more nothing is ON: its machine is used
        again. The order stays due, for an agent of that name that starts later.
        """
        now = time.monotonic()
        with self._guard:
            machine = key_expressions.machine(info.machine)
            ended = self._take_greeting(info, machine)
            self._gone.discard(info.name)
            for order in self._orders:
                for name in ended:
                    if order.machines.get(name) == machine:
                        del order.machines[name]
                if info.name not in order.due:
                    continue
                order.machines[info.name] = machine  # it is new after a reboot
                if order.id in info.stops:
                    del order.due[info.name]
                    self._changed()
                elif order.due[info.name] <= now and info.name not in order.sent:
                    order.sent.add(info.name)
                    self._pool.submit(self._repeat, order, info.name)

    def _take_greeting(self, info: m.AgentInfo, machine: str) -> set[str]:
        """Keep an agent's greeting; return RTPUs of its machine that have ended."""
        before = self._peers.get(info.name)
        here = set(info.here)
        known = before.here | before.ended if before is not None else here
        if info.name not in here:  # an agent of an earlier version does not tell it
            here = known
        subsystems = list(info.claims)
        if before is not None and not info.rtpu_pid:  # it ends, or starts the next one
            subsystems = before.subsystems
        self._peers[info.name] = _Peer(
            subsystems, machine, here=here, ended=known - here
        )
        return known - here

    def lost(self, name: str) -> None:
        """Repeat the orders of an RTPU when it is seen again, without delay."""
        with self._guard:
            self._gone.add(name)
            for order in self._orders:
                if name in order.due:
                    order.due[name] = 0.0
        self._changed()

    def ended(self, name: str) -> None:
        """Forget an RTPU that has ended in order: its tasks are OFF.

        What it has missed stays due: a stolen key can announce anybody's end.
        """
        with self._guard:
            self._peers.pop(name, None)
            for order in self._orders:
                if order.due.get(name):
                    del order.due[name]
        self._changed()

    def dropped(self, name: str) -> None:
        """Forget an RTPU that is not asked any more, unless it has an order due."""
        with self._guard:
            if not any(name in order.due for order in self._orders):
                self._peers.pop(name, None)

    def awaited(self) -> set[str]:
        """Return the agents of which it is to be seen whether orders are carried out.

        These are those of the RTPUs that have not, and others of their machines.
        """
        if not self._orders:
            return set()
        with self._guard:
            due = {name for order in self._orders for name in order.due}
            held = {
                machine
                for order in self._orders
                for name, machine in order.machines.items()
                if name in order.due
            }
            beside = (n for n, one in self._peers.items() if one.machine in held)
            return due.union(beside)

    def has_ended(self, name: str) -> bool:
        """Return whether an agent in sight says that an RTPU of its machine has ended.

        Nothing of it is ON then, though its own agent has not said so.
        """
        with self._guard:
            peer = self._peers.get(name)
            return peer is not None and any(
                name in one.ended and one.machine == peer.machine
                for other, one in self._peers.items()
                if other not in self._gone
            )

    def in_reach(self) -> list[str]:
        """Return the RTPUs that are seen now."""
        with self._guard:
            return sorted(self._peers.keys() - self._gone)

    def holds(self, machine: str) -> bool:
        """Return whether a machine that was out of reach has orders to carry out.

        Args:
            machine: The machine in the form used in keys.
        """
        with self._guard:
            return any(
                not due and order.machines.get(name) == machine
                for order in self._orders
                for name, due in order.due.items()
            )

    def holds_agent(self, name: str) -> bool:
        """Return the same of the machine of an agent."""
        return any(self.holds(machine) for machine in self._machines_of(name))

    def _machines_of(self, name: str) -> set[str]:
        """Return the machine of an RTPU, as its agent said last and as orders know it.

        Orders also know it of one that has ended, and after a restart of this agent.
        """
        with self._guard:
            found = {
                order.machines[name]
                for order in self._orders
                if name in order.machines and not order.due.get(name, 1.0)
            }
            if peer := self._peers.get(name):
                found.add(peer.machine)
        return found

    def refuses(self, subsystem: str, machine: str) -> bool:
        """Return whether a machine has not carried out a stop of a subsystem.

        Args:
            subsystem: The subsystem.
            machine: The machine in the form used in keys.
        """
        with self._guard:
            return any(
                order.machines.get(name) == machine
                for order in self._orders
                if order.subsystem in {"", subsystem}
                for name, due in order.due.items()
                if not due
            )

    def parts(self, subsystem: str, name: str) -> bool:
        """Return whether no task of a subsystem uses what an RTPU has, and none of its.

        That is the case while its machine has not carried out a stop of the subsystem.
        """
        if not self._orders:
            return False
        return any(self.refuses(subsystem, one) for one in self._machines_of(name))

    def _repeat(self, order: _Order, name: str) -> None:
        request: Order = (
            m.Replaced(tasks=order.tasks, stop_id=order.id, timeout=TIME)
            if order.tasks
            else m.Stop(stop_id=order.id, timeout=TIME)
        )
        request.subsystem = order.subsystem
        try:
            done = self._client.call(name, request, m.Stopped, timeout=TIME)
        except AccessError:  # now no gateways alone lead there; or our keys are none
            log.debug("%s: the stop of %s is left to a gateway", self._name, name)
            return
        except PbonetError as error:  # the next greeting repeats it
            log.warning("%s: %s is not stopped yet: %s", self._name, name, error)
            return
        finally:
            with self._guard:
                order.sent.discard(name)
        with self._guard:
            if order.due.pop(name, None) is None:
                return
        self._changed()
        tasks = " ".join([*done.off, *done.killed])
        if not tasks:
            return
        what = f"the stop of {order.subsystem or 'all subsystems'}"
        if order.tasks:
            what = f"the order that others replace {' '.join(order.tasks[name])}"
        ago = time.monotonic() - order.at
        text = f"{what}, given {ago:.1f} s ago, has reached {name} only now"
        note = rtpu_messages.Note(
            int(Severity.WARNING), "STOPPED", f"{text}: {tasks} turned off"
        )
        self._note(note)


def parted(rtpu: str) -> UnreachableError:
    """Return the error of a request between tasks that a missed stop keeps apart."""
    return UnreachableError(
        "it missed a stop of the subsystem, and has not carried it out yet",
        where=rtpu,
        remedy="its agent is given the stop again; until its tasks are OFF no message, "
        "semaphore or file passes between them and other machines",
    )


def _concerns(subsystem: str, subsystems: list[str]) -> bool:
    return subsystem in subsystems if subsystem else bool(subsystems)
