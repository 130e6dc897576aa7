"""Folders of shared memory, for who looks into them again and again."""

from __future__ import annotations

import os


class Changes:
    """Tells whether something was made or removed in a folder.

    After a change the folder is to be listed twice, with a look in between: its time
    stamp is too coarse to tell what came directly behind a listing.

    Args:
        path: The folder.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._stamp = -1
        self._twice = False

    def look(self) -> bool:
        """Tell whether the folder is to be listed now."""
        stamp = os.stat(self._path).st_mtime_ns  # noqa: PTH116 - three times as fast
        if stamp == self._stamp and self._twice:
            return False
        self._twice, self._stamp = stamp == self._stamp, stamp
        return True
