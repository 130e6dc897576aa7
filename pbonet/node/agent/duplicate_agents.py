"""Searches for a second agent of the same name whenever a link is opened.

Names are checked before an agent declares its own. Two agents that could not see each
other then may meet later, when a link between their machines is opened: it is then too
late to refuse one, because both control tasks. It is reported instead.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

import msgspec
import zenoh

from pbonet.errors import ProtocolError
from pbonet.xm.net import codec, convert, messages as m, run_folder

if TYPE_CHECKING:
    from collections.abc import Callable

log = logging.getLogger("pbonet.node")

SETTLE_TIME = 0.5
"""Seconds from the start of a link until all agents reached through it are known."""
ANSWER_TIME = 2.0


class DuplicateAgents:
    """The search for agents of the same name.

    Args:
        session: The agent's session.
        key: The key on which agents of that name answer.
        pid: The agent's own process.
        found: Called once for each other agent, with its identity.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        pid: int,
        found: Callable[[m.AgentInfo], None],
    ) -> None:
        self._session = session
        self._key = key
        self._me = (run_folder.machine(), pid)
        self._found = found
        self._known: set[tuple[str, int]] = set()
        self._linked = threading.Event()
        self._over = threading.Event()
        self._codec = codec.Codec()
        self._listener: zenoh.TransportEventsListener[None] | None = None
        self._thread = threading.Thread(
            target=self._watch, name="pbonet names", daemon=True
        )

    def start(self) -> None:
        """Search now, and whenever a link is opened."""
        self._listener = self._session.info.declare_transport_events_listener(
            self._on_link, history=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop searching."""
        self._over.set()
        self._linked.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._listener is not None:
            self._listener.undeclare()  # type: ignore[no-untyped-call]

    def _on_link(self, _event: zenoh.TransportEvent) -> None:
        self._linked.set()

    def _watch(self) -> None:
        while not self._over.is_set():
            self._linked.wait()
            self._linked.clear()
            if not self._over.wait(SETTLE_TIME):
                self._ask_identities()

    def _ask_identities(self) -> None:
        """Ask all agents of that name for their identity."""
        try:
            replies = self._session.get(
                self._key,
                payload=self._codec.pack(m.Hello(id="twin")),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWER_TIME,
            )
            answers = [r.ok.payload.to_bytes() for r in replies if r.ok is not None]
        except zenoh.ZError as error:
            log.debug("no agent could be asked for the name: %s", error)
            return
        for data in answers:
            self._judge(data)

    def _judge(self, data: bytes) -> None:
        try:
            info = convert(self._codec.answer(data).result, m.AgentInfo)
        except (ProtocolError, msgspec.ValidationError):
            return  # another version; its master will report it
        who = (info.machine, info.pid)
        if who != self._me and who not in self._known:
            self._known.add(who)
            self._found(info)
