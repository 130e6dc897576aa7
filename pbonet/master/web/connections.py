"""Connections of browsers before they are WebSockets: few, and none of them for long.

Anybody who reaches the port can open connections and say nothing. They must not keep
browsers away, or use up the files that this process may open.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final, cast

from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    from collections.abc import Iterable

MOST: Final = 100
"""Connections at a time that are no WebSockets; one more ends the oldest."""
TIME: Final = 30.0
"""Seconds for which one may last; the whole page is loaded in less."""


def leave_out_junk() -> None:
    """Log nothing of requests that are no HTTP: anybody can send any number of them."""
    logging.getLogger("uvicorn.error").addFilter(_is_no_junk)


def _is_no_junk(record: logging.LogRecord) -> bool:
    kind = record.exc_info[0] if record.exc_info else None
    junk = kind is not None and kind.__module__.startswith("h11.")
    return record.levelno >= logging.ERROR and not junk


class Connection(H11Protocol):
    """A connection that ends soon, unless it becomes a WebSocket."""

    opened = 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Serve it for a time; end the oldest if there are too many."""
        super().connection_made(cast("asyncio.Transport", transport))
        self.opened = self.loop.time()
        self.loop.call_later(TIME, self.end)
        alive = [one for one in self._others() if not one.transport.is_closing()]
        if len(alive) > MOST:
            min(alive, key=lambda one: one.opened).end()

    def _others(self) -> Iterable[Connection]:
        return (one for one in self.connections if isinstance(one, Connection))

    def end(self) -> None:
        """Close it, unless it is a WebSocket now."""
        if self.transport.get_protocol() is self:
            self.transport.abort()
