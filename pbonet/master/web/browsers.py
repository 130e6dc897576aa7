"""The browsers that are connected, and what waits to be sent to each.

A browser that reads slowly gets fewer values, and always the newest; one that does not
read at all is let go. No browser delays another one, or the watcher.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import msgspec

from .access import Role

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

Data = dict[str, Any]
MOST: Final = 32
"""Browsers at a time."""
FOR_OPERATORS: Final = 4
"""Of these, the places that no observer takes."""
MOST_WATCHED: Final = 200
"""Variables that one browser may watch."""
_WAITING: Final = 500
"""Messages beside values that may wait for a browser; more of them end it."""
_BYTES: Final = 32_000_000
"""Bytes of these messages."""


class Browser:
    """One connection: what it watches, and what waits for it.

    Args:
        role: What it may do.
    """

    def __init__(self, role: Role) -> None:
        self.role = role
        self.watched: frozenset[str] = frozenset()
        self.lost = False
        """Set when too much waits for it."""
        self.unheard: set[str] = set()
        """Variables of which it waits for what was before."""
        self._texts: deque[bytes] = deque()
        self._bytes = 0
        self._values: dict[str, Data] = {}
        self._time = 0.0
        self._there = asyncio.Event()

    def put(self, text: bytes) -> None:
        """Have a message sent."""
        full = len(self._texts) >= _WAITING or self._bytes >= _BYTES
        self.lost = self.lost or full
        if not self.lost:
            self._texts.append(text)
            self._bytes += len(text)
        self._there.set()

    def put_values(self, message: Data) -> None:
        """Have those values sent that it watches; what waits is replaced."""
        values = message["values"]
        wanted = {name: values[name] for name in self.watched & values.keys()}
        if wanted:
            self._values |= wanted
            self._time = message["t"]
            self._there.set()

    async def take(self) -> list[bytes]:
        """Wait until something is to be sent; return it."""
        await self._there.wait()
        self._there.clear()
        texts = [*self._texts]
        self._texts.clear()
        self._bytes = 0
        if self._values:
            message = {"kind": "values", "t": self._time, "values": self._values}
            texts.append(msgspec.json.encode(message))
            self._values = {}
        return texts


class Browsers:
    """All browsers; used in the server's event loop alone.

    Args:
        watched: Called with the variables that some browser watches.
    """

    def __init__(self, watched: Callable[[Iterable[str]], None]) -> None:
        self._watched = watched
        self._browsers: list[Browser] = []

    def are_full(self, role: Role) -> bool:
        """Return whether no more can be served; observers keep no operator out."""
        kept = 0 if role is Role.OPERATOR else FOR_OPERATORS
        return len(self._browsers) >= MOST - kept

    def add(self, browser: Browser) -> None:
        """Serve one more."""
        self._browsers.append(browser)

    def remove(self, browser: Browser) -> None:
        """Serve one no more."""
        self._browsers.remove(browser)
        self.rewatch()

    def rewatch(self) -> None:
        """Take in that a browser watches other variables."""
        self._watched({name for one in self._browsers for name in one.watched})

    def send(self, message: Data) -> None:
        """Send a message to all."""
        if message["kind"] == "values":
            for browser in self._browsers:
                browser.put_values(message)
            return
        text = msgspec.json.encode(message)
        for browser in self._browsers:
            browser.put(text)
