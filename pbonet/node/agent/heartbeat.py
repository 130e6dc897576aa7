"""Signs of life between agents, and the care for their links during an interruption.

An agent that gives no sign of life for 0.4 s is out of sight: its machine's variables
have no writer then, though the link is kept for some seconds, because an interruption
is often over before a new link could be made.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from typing import TYPE_CHECKING, NamedTuple

import zenoh

from pbonet.node.wire import process_setup
from pbonet.xm.net import direct, key_expressions, session

from .retransmission import Retransmission

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.xm.net import AgentInfo

log = logging.getLogger("pbonet.node")

TURN = 0.025
"""Seconds between checks of the links."""
BEAT_TURNS = 4
"""Turns between two signs of life."""
FIND_TURNS = 40
"""Turns between searches for new connections."""
FORGET = 60.0
"""Seconds after which an agent that is out of sight is forgotten."""
_LEAF = "beat"


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

    def __init__(self, machine: str) -> None:
        self.machine = machine
        self.heard = time.monotonic()
        self.seen = True


class Heartbeat:
    """An agent's signs of life, and those of the others.

    Args:
        link: The agent's session.
        me: The agent's identity.
        report: Called when another agent goes out of sight or comes back, in zenoh's
            thread or in one of its own.
    """

    def __init__(
        self,
        link: zenoh.Session,
        me: AgentInfo,
        report: Callable[[Change], None],
    ) -> None:
        self._session, self._report = link, report
        self._domain, self._name = me.domain, me.name
        self._machine = key_expressions.machine(me.machine).encode()
        self._agents: dict[str, _Agent] = {}
        self._began = time.monotonic()
        self._guard = threading.Lock()
        self._over = threading.Event()
        self._retransmission = Retransmission()
        self._thread = threading.Thread(
            target=self._work, name="pbonet beat", daemon=True
        )

    def start(self) -> None:
        """Start to give signs of life, and to expect them."""
        self._subscriber = self._session.declare_subscriber(
            key_expressions.all_rtpus(self._domain, _LEAF),
            direct(self._note_beat),
            allowed_origin=zenoh.Locality.REMOTE,
        )
        self._publisher = self._session.declare_publisher(
            key_expressions.rtpu(self._domain, self._name, _LEAF),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        self._thread.start()

    def stop(self) -> None:
        """End both."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def silence(self, name: str) -> float:
        """Return for how many seconds an agent's machine has given no sign of life.

        An agent that was never heard counts as heard at the start.
        """
        with self._guard:
            agent = self._agents.get(name)
            if name == self._name or (
                agent is not None and agent.machine == self._machine.decode()
            ):
                return 0.0
            heard = [
                one.heard
                for one in self._agents.values()
                if agent is not None and one.machine == agent.machine
            ]
        return time.monotonic() - max(heard, default=self._began)

    def is_silent(self, name: str) -> bool:
        """Return whether an agent is out of sight, though its link may still exist."""
        agent = self._agents.get(name)
        return agent is not None and not agent.seen

    def _note_beat(self, sample: zenoh.Sample) -> None:
        """Note a sign of life; runs in zenoh's own thread."""
        name = key_expressions.rtpu_name(str(sample.key_expr))
        with self._guard:
            agent = self._agents.get(name)
            if agent is None:
                machine = sample.payload.to_bytes().decode(errors="replace")
                agent = self._agents[name] = _Agent(machine)
            agent.heard = time.monotonic()
            back, agent.seen = not agent.seen, True
        if back:
            self._report(Change(name, agent.machine, seen=True, last=False))

    def _work(self) -> None:
        process_setup.go_before_others()
        turn = 0
        while not self._over.wait(TURN):
            try:
                if turn % FIND_TURNS == 0:
                    self._retransmission.find()
                self._retransmission.tend()
                if turn % BEAT_TURNS == 0:
                    with contextlib.suppress(zenoh.ZError):
                        self._publisher.put(self._machine)  # pyright: ignore[reportUnknownMemberType]
                self._check(time.monotonic())
            except Exception:  # a fault in one turn must not end the signs of life
                log.exception("the links could not be checked")
            turn += 1

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
                here = agent.machine == self._machine.decode()  # see `silence`
                if last and not here and agent.heard < now - FORGET:
                    self._agents.pop(name, None)
            if gone:
                self._report(Change(name, agent.machine, seen=False, last=last))
