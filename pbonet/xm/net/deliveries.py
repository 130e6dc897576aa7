"""Requests that are delivered in order, while their sender does not wait.

The thesis's `xmWakeup` does not wait for an acknowledgment either (Stewart 1994,
section 5.3.1). Here the answer is waited for by a thread, so that what could not be
delivered is reported.
"""

from __future__ import annotations

import queue
import threading
import time
from typing import TYPE_CHECKING, Final, Protocol

from pbonet.errors import PbonetError

if TYPE_CHECKING:
    from collections.abc import Callable

    from .messages import Request

ROOM: Final = 64
"""Requests that may wait to be delivered."""
TIME: Final = 2.0
"""Seconds in which an agent must carry out one of them."""
PAUSE: Final = 1.0
"""Seconds between two reports; failures of the time between are reported together."""


class Caller(Protocol):
    """Sends a request and returns its result, such as a `Client`."""

    def call(
        self, rtpu: str, request: Request, result: type[object], *, timeout: float
    ) -> object:
        """Return the result; raises a `PbonetError`."""
        ...


class Deliveries:
    """Sends requests one after the other, in a thread that starts with the first one.

    Args:
        client: Sends them.
        failed: Called in that thread with a sentence about what was not delivered.
    """

    def __init__(self, client: Caller, failed: Callable[[str], None]) -> None:
        self._client, self._failed = client, failed
        self._queue: queue.Queue[tuple[str, Request] | None] = queue.Queue(ROOM + 1)
        self._thread: threading.Thread | None = None
        self._lost = 0
        """Requests that were not delivered and are not reported yet."""
        self._why = ""
        self._reported = 0.0
        self._guard = threading.Lock()
        self._ended = False

    def add(self, rtpu: str, request: Request) -> None:
        """Deliver a request after those before it; return at once.

        If more than `ROOM` wait, it is dropped, and that is reported.
        """
        if self._ended:
            return
        if self._thread is None:
            self._thread = threading.Thread(
                target=self._work, name="pbonet deliveries", daemon=True
            )
            self._thread.start()
        if self._queue.qsize() >= ROOM:
            self._count(f"{rtpu}: more than {ROOM} wait to be delivered there")
        else:
            self._queue.put_nowait((rtpu, request))

    def end(self) -> None:
        """End; what still waits is not delivered."""
        self._ended = True
        if self._thread is not None:
            self._queue.put(None)

    def _count(self, why: str) -> None:
        with self._guard:
            self._lost, self._why = self._lost + 1, why

    def _work(self) -> None:
        while not self._ended:
            try:
                one = self._queue.get(timeout=PAUSE if self._lost else None)
            except queue.Empty:
                one = None
            if one is not None and not self._ended:
                self._deliver(*one)
            self._report()

    def _deliver(self, rtpu: str, request: Request) -> None:
        try:
            self._client.call(rtpu, request, object, timeout=TIME)
        except PbonetError as error:
            self._count(str(error))

    def _report(self) -> None:
        now = time.monotonic()
        with self._guard:
            if not self._lost or now - self._reported < PAUSE:
                return
            lost, self._lost, self._reported = self._lost, 0, now
            why = self._why
        what = "a signal or message was" if lost == 1 else f"{lost} of its signals were"
        self._failed(f"{what} not delivered: {why}")
