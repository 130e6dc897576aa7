"""Warnings of a bridge while it runs: each once, and again after some seconds."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

from pbonet.lazy import logger

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.errors import PbonetError

_PAUSE: Final = 10.0
"""Seconds after which a warning about the same is shown again."""
_MOST: Final = 50
"""Warnings that are shown in that time at most, as others choose the names in them."""
_LONG: Final = 1000
"""Characters of a warning at most."""
_KEPT: Final = 1000


class Warnings:
    """Shows warnings of things that may happen a thousand times a second.

    Args:
        show: Called with each sentence that is to be seen; any thread calls it.
    """

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = [show]
        self._shown: dict[str, tuple[float, int]] = {}
        self._since, self._count, self._left_out = -_PAUSE, 0, 0
        self._lock = threading.Lock()

    def also(self, show: Callable[[str], None]) -> None:
        """Show each sentence there, too."""
        self._show.append(show)

    def warn(self, about: str, what: str, details: str = "") -> None:
        """Show a sentence, unless the same or too many were shown a moment ago.

        Args:
            about: What it is about, such as a topic.
            what: What happens; always the same words for the same thing.
            details: More about it, which may differ each time.
        """
        key, now = _line(f"{about}: {what}"), time.monotonic()
        with self._lock:
            last, more = self._shown.get(key, (-_PAUSE, 0))
            if now - last < _PAUSE:
                self._shown[key] = last, more + 1
                return
            if not self._has_room(now):
                self._left_out += 1
                return
            left_out, self._left_out = self._left_out, 0
            if len(self._shown) >= _KEPT:
                self._shown.clear()
            self._shown[key] = now, 0
        text = _line(f"{key}{details}") + (f" ({more} more times)" if more else "")
        if left_out:
            text += f" ({left_out} other warnings were left out)"
        for show in self._show:
            show(text)

    def warn_of(self, about: str, error: PbonetError) -> None:
        """Show an error."""
        self.warn(about, error.what, str(error).partition(error.what)[2])

    def failed(self, about: str, error: Exception) -> None:
        """Show a failure that is a fault of pbonet, and log where it was."""
        logger("pbonet.ros2").error("%s failed", about, exc_info=error)
        self.warn(about, "it failed inside pbonet", f": {error}")

    def over(self, about: str, what: str) -> None:
        """Show this at once when it happens again."""
        with self._lock:
            self._shown.pop(_line(f"{about}: {what}"), None)

    def _has_room(self, now: float) -> bool:
        """Count a sentence; return whether it may be shown."""
        if now - self._since >= _PAUSE:
            self._since, self._count = now, 0
        self._count += 1
        return self._count <= _MOST


def _line(text: str) -> str:
    """Return a text as one line that can be shown, whatever a node has sent."""
    short = text if len(text) <= _LONG else f"{text[:_LONG]}..."
    return "".join(one if one.isprintable() else "?" for one in short)
