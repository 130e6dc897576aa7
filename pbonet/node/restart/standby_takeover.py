"""Standbys that take over by themselves when an original on another RTPU is lost.

A master says when an original has been turned ON, and before it turns it off. In
between, it is lost if no task writes the variables of its standby, and its RTPU says
that it is not ON or says nothing. Where another agent of its machine says that this
RTPU has ended, it is not ON. If its machine is out of sight,
that machine must have been alone for as long: unheard here and by the keeper's machine
(`Signs.absence`). Its CRITICAL tasks run `stable` by then, for its own agents count
the same time (``ALONE``), which is shorter.

Nothing is lost of a subsystem that is stopped: agents that have the stop say so while
it has not arrived here (`AgentInfo.due`).

Before the standby is turned ON, the keeper's agent, this one, and all others in reach
have the order to turn the original OFF when it is seen again (`Orders`). If it comes
back before that, the order is forgotten here. An agent that has it already turns the
original OFF; that is a new loss.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from typing import TYPE_CHECKING, Final, Protocol

from msgspec import Struct, structs

from pbonet.errors import NodeError, PbonetError
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import messages as m, session

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    import msgspec

log = logging.getLogger("pbonet.node")

TURN: Final = 0.1
"""Seconds between checks while there is a standby."""
TIME: Final = 2.0
"""Seconds for an RTPU to turn the original off."""
PAUSE: Final = 1.0
"""Seconds until the keeper is asked again."""


class Signs(Protocol):
    """Knows who is out of sight, such as `Heartbeat`."""

    def is_seen(self, name: str) -> bool:
        """Return whether an agent is in sight."""
        ...

    def is_here(self, name: str) -> bool:
        """Return whether an agent is known to be on this machine."""
        ...

    def absence(self, subsystem: str, name: str, keeper: str) -> float:
        """Return for how many seconds an agent's machine was surely alone."""
        ...


class Caller(Protocol):
    """Sends requests to other RTPUs, such as `pbonet.xm.net.Client`."""

    def call_all(
        self,
        requests: Mapping[str, m.Request],
        result: type[m.Stopped],
        *,
        timeout: float,
    ) -> tuple[dict[str, m.Stopped], list[PbonetError]]:
        """Return the results by RTPU, and the errors of the others."""
        ...


class Orders(Protocol):
    """Repeats orders to RTPUs that are out of reach, such as `StopOrders`."""

    def add(self, request: m.Replaced) -> None:
        """Take an order."""

    def in_reach(self) -> list[str]:
        """Return the RTPUs that are seen now."""
        ...

    def has_ended(self, name: str) -> bool:
        """Return whether an agent beside it says that an RTPU has no process."""
        ...


class _Watched(Struct):
    standby: rtpu_messages.Standby
    keeper: str
    missing: bool = False
    """Whether the RTPU of the original says that it is not ON."""
    ended: bool = False
    """Whether that has ended in order, and the original has not been ON since."""
    stopped: set[str] = set()
    """RTPUs that say that a stop of the subsystem is to be carried out here."""
    since: float | None = None
    """Since when it has been lost."""
    order: m.Replaced | None = None
    """The order that it be turned off, once it is being given."""
    again: float = 0.0
    """When that may be tried again."""


class Takeovers:
    """The standbys of one RTPU whose originals its agent watches.

    Args:
        name: The RTPU.
        client: Sends orders to other RTPUs.
        signs: The other agents' signs of life.
        orders: Repeats orders to RTPUs that are out of reach.
        written: Returns whether a task writes any of a subsystem's variables.
        send: Sends a message to the RTPU process.
    """

    def __init__(
        self,
        name: str,
        client: Caller,
        signs: Signs,
        orders: Orders,
        *,
        written: Callable[[str, Iterable[str]], bool],
        send: Callable[[msgspec.Struct], None],
    ) -> None:
        self._name, self._client = name, client
        self._signs, self._orders = signs, orders
        self._is_written, self._send = written, send
        self._watched: list[_Watched] = []
        self._guard = threading.Lock()
        self._some = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(
            target=self._work, name="pbonet takeover", daemon=True
        )

    def start(self) -> None:
        """Start to watch."""
        self._thread.start()

    def stop(self) -> None:
        """End."""
        self._over.set()
        self._some.set()
        if self._thread.is_alive():
            self._thread.join()

    def update(self, info: rtpu_messages.RtpuInfo) -> None:
        """Watch the originals of the standbys that the RTPU process names."""
        with self._guard:
            known = {structs.astuple(one.standby): one for one in self._watched}
            self._watched = [
                known.get(structs.astuple(standby)) or _Watched(standby, table.keeper)
                for standby in info.standbys
                if (table := info.tables.get(standby.subsystem)) is not None
            ]
            (self._some.set if self._watched else self._some.clear)()

    def met(self, info: m.AgentInfo) -> None:
        """Take in whether an agent's RTPU has originals ON, and stops that it knows."""
        stops = {subsystem for _, subsystem in info.due.get(self._name, ())}
        with self._guard:
            watched = list(self._watched)
        for one in watched:
            subsystem = one.standby.subsystem
            known = stops & {"", subsystem}
            (one.stopped.add if known else one.stopped.discard)(info.name)
            if one.standby.rtpu == info.name:
                on = info.on.get(subsystem, [])
                one.missing = one.standby.original not in on
                one.ended = one.ended and one.missing

    def lost(self, name: str) -> None:
        """Do nothing: signs of life say when an agent is out of sight."""

    def dropped(self, name: str) -> None:
        """Do nothing: originals are in the subsystem, and their agents are asked."""

    def ended(self, name: str) -> None:
        """Take in that an agent has turned its tasks off and ended."""
        with self._guard:
            watched = list(self._watched)
        for one in watched:
            one.ended = one.ended or one.standby.rtpu == name

    def _work(self) -> None:
        while not self._over.wait(TURN):
            self._some.wait()
            try:
                self.turn(time.monotonic())
            except Exception:  # a fault in one turn must not end the watch
                log.exception("the originals could not be checked")

    def turn(self, now: float) -> None:
        """Check each original, and have standbys take over."""
        with self._guard:
            watched = list(self._watched)
        for one in watched:
            one.since = self._lost_since(one, now)
            if one.since is None:
                one.order = None
            elif now >= max(one.since + one.standby.takeover, one.again):
                self._replace(one, now)

    def _lost_since(self, one: _Watched, now: float) -> float | None:
        """Return since when an original has been lost; None: it is not."""
        standby, since = one.standby, now if one.since is None else one.since
        if one.ended or one.stopped:
            return None
        if self._is_written(standby.subsystem, standby.outputs):
            return None
        if self._signs.is_seen(standby.rtpu):
            return since if one.missing else None
        if self._orders.has_ended(standby.rtpu):
            return since
        alone = self._signs.absence(standby.subsystem, standby.rtpu, one.keeper)
        if alone < session.SILENT_MS * 1e-3:
            return None
        return max(since, now - alone)  # it may have been heard between two turns

    def _replace(self, one: _Watched, now: float) -> None:
        """Give the order that the original be turned off, then turn the standby on."""
        standby = one.standby
        order = one.order = one.order or m.Replaced(
            subsystem=standby.subsystem,
            stop_id=os.urandom(8).hex(),
            tasks={standby.rtpu: [standby.original]},
            timeout=TIME,
        )
        others = [name for name in self._orders.in_reach() if name != one.keeper]
        needed = [] if self._signs.is_here(one.keeper) else [one.keeper]
        if needed and self._ask(needed, order):
            one.again = now + PAUSE
            return
        self._orders.add(order)
        self._ask(others, order)
        if self._lost_since(one, now) is None:
            return  # it came back meanwhile; the order turns it off first
        seconds = f"no task has written its variables for {standby.takeover:g} s"
        try:
            self._send(
                rtpu_messages.TakeOver(standby.subsystem, standby.standby, seconds)
            )
        except NodeError as error:
            log.warning("%s: %s does not take over: %s", self._name, standby, error)
        one.order, one.since = None, None

    def _ask(self, names: list[str], order: m.Replaced) -> list[PbonetError]:
        """Give an order to RTPUs; return the errors of those that do not take it."""
        requests = {name: structs.replace(order) for name in names}
        _, errors = self._client.call_all(requests, m.Stopped, timeout=TIME)
        for error in errors:
            log.warning("%s: the order is repeated later: %s", self._name, error)
        return errors


__all__ = ["Takeovers"]
