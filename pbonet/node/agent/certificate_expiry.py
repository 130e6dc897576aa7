"""How long an agent's keys are good for, and whether others take them.

When a certificate runs out the links that it opened are closed, on either side, and no
new ones come, as if every cable had been pulled. Whoever is to make another one hears
of it for weeks before, and is told what is wrong when it has happened. So it is when
two agents have keys of different authorities, as while those of a laboratory are
replaced: zenoh says nothing of it, and who dials would only find that nobody answers.
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
"""Seconds between looks at the clock, for it may be set."""
LINK_LOOK = 2.0
"""Seconds between looks at links that are to be there and are not."""
_END = 1.0
"""Seconds that the end waits for a look."""


class KeyTerm:
    """The time of the keys that an agent's session was opened with.

    Args:
        folder: The key folder; None if there are no keys.
        name: The agent's.
        tell: Takes what is to be told to masters.
        unlinked: Returns the endpoints that are dialled, and to which no link stands.
    """

    def __init__(
        self,
        folder: Path | None,
        name: str,
        tell: Callable[[rtpu_messages.Note], None],
        unlinked: Callable[[], Iterable[str]] = tuple,
    ) -> None:
        self._folder, self._name, self._tell = folder, name, tell
        self._unlinked = unlinked
        self._refused: dict[str, str] = {}
        """Why there is no link to an endpoint, as it was told."""
        self._until = credentials.prove(folder) if folder is not None else None
        self._over = threading.Event()
        self._thread = threading.Thread(
            target=self._watch, name="pbonet key term", daemon=True
        )

    @property
    def left(self) -> float | None:
        """Seconds that the keys are good for; None if there are none."""
        return None if self._until is None else credentials.left(self._until)

    def start(self) -> None:
        """Tell when it is time."""
        if self._until is not None:
            self._thread.start()

    def stop(self) -> None:
        """Tell nothing any more; a name that is being looked up is not waited for."""
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
                self._look_at_links()
            if self._over.wait(min(LOOK, LINK_LOOK, max(left, 0.0) or LOOK)):
                return

    def _look_at_links(self) -> None:
        """Tell where the keys of two agents keep a link from standing."""
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
            f"no link to {endpoint}: {why}; if the keys of one of the two are old, put "
            f"others of one authority there, here into {self._folder}, and have that "
            f"agent start anew, this one with `kill -HUP {os.getpid()}`"
        )
        log.warning("%s: %s", self._name, text)
        self._tell(rtpu_messages.Note(int(Severity.ERROR), "KEYS_REFUSED", text))

    def _say(self, left: float) -> None:
        remedy = (
            f"make others with `pbonet keys agent`, put them into {self._folder}, and "
            f"have the agent start anew with `kill -HUP {os.getpid()}`; its tasks go on"
        )
        if left > 0:
            severity = Severity.WARNING
            text = f"the keys run out in {credentials.days(left)}; {remedy}"
        else:
            severity = Severity.ERROR
            text = "the keys have run out: no other machine can be reached any more; "
            text += remedy
        log.warning("%s: %s", self._name, text)
        self._tell(rtpu_messages.Note(int(severity), "KEYS_RUN_OUT", text))
