"""Watches folders of shared memory that are listed again and again."""

from __future__ import annotations

import os
import time

TICK_NS = 20_000_000
"""A folder's time stamp is that of the last tick of the kernel, some ms ago at most."""


class Changes:
    """Detects whether something was made or removed in a folder.

    After a change the folder is to be listed until its time stamp has stood for longer
    than a tick: it cannot tell what came directly behind a listing.

    Args:
        path: The folder.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._stamp = -1
        self._since = 0
        self._settled = False

    def look(self) -> bool:
        """Return whether the folder is to be listed now."""
        stamp = os.stat(self._path).st_mtime_ns  # noqa: PTH116 - three times as fast
        if stamp == self._stamp and self._settled:
            return False
        now = time.monotonic_ns()
        if stamp != self._stamp:
            self._stamp, self._since = stamp, now
        self._settled = now - self._since > TICK_NS
        return True
