"""Repeated requests: executed once, answered each time."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    Reply = Callable[[bytes], None]

KEPT = 1 << 20
"""Maximum bytes of stored answers; the oldest are dropped first."""
OVERHEAD = 256
"""Bytes that each answer counts in addition to its own."""
REQUESTS = 4096
"""Maximum number of requests known to be recorded; the oldest are dropped first."""


class RepeatedRequests:
    """Stored answers by client and request id.

    A client repeats a request if a link was lost meanwhile, so the newest answers are
    enough.
    """

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._under_way: dict[tuple[str, str], list[Reply]] = {}
        self._answers: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._size = 0

    def begin(self, who: tuple[str, str], reply: Reply) -> bool:
        """Return whether a request is new; a repeated one gets the same answer."""
        with self._guard:
            waiting = self._under_way.get(who)
            if waiting is not None:
                waiting.append(reply)
                return False
            known = self._answers.get(who)
            if known is None:
                self._under_way[who] = [reply]
                return True
        reply(known)
        return False

    def end(self, who: tuple[str, str], data: bytes) -> None:
        """Answer a request and its repetitions."""
        with self._guard:
            waiting = self._under_way.pop(who, [])
            self._answers[who] = data
            self._size += len(data) + OVERHEAD
            while self._size > KEPT:
                _, old = self._answers.popitem(last=False)
                self._size -= len(old) + OVERHEAD
        for reply in waiting:
            reply(data)


class RecordedRequests:
    """The recorded requests: a repeated one is not recorded again."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._noted: OrderedDict[tuple[str, str], None] = OrderedDict()

    def first(self, client: str, request_id: str) -> bool:
        """Return whether a request must be recorded, and mark it as recorded."""
        if not request_id:
            return True
        who = client, request_id
        with self._guard:
            new = who not in self._noted
            self._noted[who] = None
            self._noted.move_to_end(who)
            if len(self._noted) > REQUESTS:
                self._noted.popitem(last=False)
        return new
