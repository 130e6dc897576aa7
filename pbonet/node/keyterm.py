"""How long an agent's keys are good for: told ahead, and when their time is over.

When a certificate runs out the links that it opened are closed, on either side, and no
new ones come, as if every cable had been pulled. Whoever is to make another one hears
of it for weeks before, and is told what is wrong when it has happened.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import TYPE_CHECKING

from pbonet.errors import Severity
from pbonet.xm import credentials

from . import wire

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

log = logging.getLogger("pbonet.node")

DAY = 86400.0
LOOK = 600.0
"""Seconds between looks at the clock, for it may be set."""


class KeyTerm:
    """The time of the keys that an agent's session was opened with.

    Args:
        folder: The key folder; None if there are no keys.
        name: The agent's.
        tell: Takes what is to be told to masters.
    """

    def __init__(
        self, folder: Path | None, name: str, tell: Callable[[wire.Note], None]
    ) -> None:
        self._folder, self._name, self._tell = folder, name, tell
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
        """Tell nothing any more."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        told = None
        while (left := self.left) is not None:
            days = left // DAY if left > 0 else -1.0
            if left < credentials.SOON and days != told:
                self._say(left)
                told = days
            if self._over.wait(min(left, LOOK) if left > 0 else LOOK):
                return

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
        self._tell(wire.Note(int(severity), "KEYS_RUN_OUT", text))
