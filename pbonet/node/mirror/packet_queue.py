"""A bounded queue of received packets; dropped ones are counted.

Zenoh's threads add packets and the carrier's thread takes them. If that is too slow,
the oldest are dropped: each packet holds the newest values, and every half second a
machine sends everything again.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

WAITING = 256
"""Maximum number of waiting packets of each table."""


class PacketQueue:
    """The received packets of one table that were not taken yet.

    Args:
        ring: Lets the carrier's thread call `taken`; may be called from any thread.
        room: Maximum number of waiting packets.
    """

    def __init__(self, ring: Callable[[], None], room: int = WAITING) -> None:
        self._ring = ring
        self._guard = threading.Lock()
        self._waiting: deque[tuple[str, bytes]] = deque()
        self._room = room
        self._rung = False
        self.lost: Counter[str] = Counter()
        """Number of dropped packets by machine."""

    def put(self, machine: str, data: bytes) -> None:
        """Add a packet; runs in zenoh's threads."""
        with self._guard:
            if len(self._waiting) >= self._room:
                self.lost[self._waiting.popleft()[0]] += 1
            self._waiting.append((machine, data))
            rung, self._rung = self._rung, True
        if not rung:
            self._ring()

    def taken(self) -> list[bytes]:
        """Return the waiting packets, oldest first."""
        with self._guard:
            found = [data for _, data in self._waiting]
            self._waiting.clear()
            self._rung = False
        return found
