"""The time for which an agent's keys are valid, and whether other agents accept them.

When a certificate expires, the links that it opened are closed on both sides and no
new ones can be opened, as if every cable had been pulled. Operators are warned for
weeks before, and the cause is reported when it has happened. zenoh keeps a link that
was opened in the second in which the certificate expired; it is cut here.

It is also reported if two agents have keys of different authorities, for example while
a laboratory replaces its keys: zenoh does not do so, and the dialling side would only
get no answer.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import TYPE_CHECKING

from pbonet.errors import Severity
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import credentials

from . import link_watchdog

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

log = logging.getLogger("pbonet.node")

DAY = 86400.0
LOOK = 600.0
"""Seconds between checks of the clock, because it may be set."""
LINK_LOOK = 2.0
"""Seconds between checks of links that should exist but do not."""
_END = 1.0
"""Seconds to wait for a check at the end."""


class KeyTerm:
    """The validity of the keys with which an agent's session was opened.

    Args:
        folder: The key folder; None if there are no keys.
        name: The agent's name.
        tell: Called with reports for masters.
        unlinked: Returns the dialled endpoints without a link.
        cut: Called again and again when the keys have expired, to cut all links.
    """

    def __init__(
        self,
        folder: Path | None,
        name: str,
        tell: Callable[[rtpu_messages.Note], None],
        unlinked: Callable[[], Iterable[str]] = tuple,
        cut: Callable[[], object] = bool,
    ) -> None:
        self._folder, self._name, self._tell = folder, name, tell
        self._unlinked, self._cut = unlinked, cut
        self._refused: dict[str, str] = {}
        """The reported reason why there is no link, by endpoint."""
        self._until = credentials.prove(folder) if folder is not None else None
        self._over = threading.Event()
        self._thread = threading.Thread(
            target=self._watch, name="pbonet key term", daemon=True
        )

    @property
    def left(self) -> float | None:
        """Seconds for which the keys are valid; None if there are none."""
        return None if self._until is None else credentials.left(self._until)

    def start(self) -> None:
        """Start to report expiry."""
        if self._until is not None:
            self._thread.start()

    def stop(self) -> None:
        """Stop reporting, without waiting for a name that is being resolved."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(_END)

    def _watch(self) -> None:
        told = None
        while (left := self.left) is not None:
            days = left // DAY if left > 0 else -1.0
            if left < credentials.SOON and days != told:
                self._say(left)
                told = days
            if left > 0:
                self._check_links()
            else:
                self._cut()
            if self._over.wait(min(LOOK, LINK_LOOK, max(left, 0.0) or LOOK)):
                return

    def _check_links(self) -> None:
        """Report links that the keys of two agents prevent."""
        if self._folder is None:
            return
        unlinked = set(self._unlinked())
        for endpoint in self._refused.keys() - unlinked:
            del self._refused[endpoint]
        for endpoint in sorted(unlinked):
            if self._over.is_set():
                return
            host, _, port = link_watchdog.inside(endpoint).rpartition(":")
            why = credentials.doubted(self._folder, host.strip("[]"), int(port))
            if why and why != self._refused.get(endpoint):
                self._say_refused(endpoint, why)
                self._refused[endpoint] = why

    def _say_refused(self, endpoint: str, why: str) -> None:
        text = (
            f"no link to {endpoint}: {why}; if one of the two agents has old or "
            f"revoked keys, replace them by keys of the common authority (here in "
            f"{self._folder}), "
            f"and restart that agent (this one with `kill -HUP {os.getpid()}`)"
        )
        log.warning("%s: %s", self._name, text)
        self._tell(rtpu_messages.Note(int(Severity.ERROR), "KEYS_REFUSED", text))

    def _say(self, left: float) -> None:
        remedy = (
            "make new ones with `pbonet keys agent`, or `pbonet keys gateway` if "
            f"commands pass through this agent, put them into {self._folder}, and "
            f"restart the agent with `kill -HUP {os.getpid()}`; its tasks continue"
        )
        if left > 0:
            severity = Severity.WARNING
            text = f"the keys expire in {credentials.days(left)}; {remedy}"
        else:
            severity = Severity.ERROR
            text = "the keys have expired: no other machine can be reached; "
            text += remedy
        log.warning("%s: %s", self._name, text)
        self._tell(rtpu_messages.Note(int(severity), "KEYS_EXPIRE", text))
