"""Detects changes of shared memory folders that are listed repeatedly."""

from __future__ import annotations

import os
import time

TICK_NS = 20_000_000
"""Resolution of a folder's time stamp: the kernel's clock tick, some milliseconds."""


class Changes:
    """Detects whether a file was made or removed in a folder.

    After a change the folder must be listed until its time stamp has not changed for
    longer than a tick: the stamp cannot show a change directly after a listing.

    Args:
        path: The folder.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._stamp = -1
        self._since = 0
        self._settled = False

    def changed(self) -> bool:
        """Return whether the folder must be listed now."""
        stamp = os.stat(self._path).st_mtime_ns  # noqa: PTH116 - three times as fast
        if stamp == self._stamp and self._settled:
            return False
        now = time.monotonic_ns()
        if stamp != self._stamp:
            self._stamp, self._since = stamp, now
        self._settled = now - self._since > TICK_NS
        return True
