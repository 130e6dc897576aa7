"""Repeated requests: carried out once, answered as often as they come."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    Reply = Callable[[bytes], None]

KEPT = 1 << 20
"""Bytes of answers that are kept; the oldest go first."""
OVERHEAD = 256
"""Bytes that an answer counts in addition to its own."""
REQUESTS = 4096
"""Requests that are known to be recorded; the oldest go first."""


class RepeatedRequests:
    """Answers by client and the request's id.

    A request is repeated when a link was lost meanwhile, so the newest answers suffice.
    """

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._under_way: dict[tuple[str, str], list[Reply]] = {}
        self._answers: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._size = 0

    def begin(self, who: tuple[str, str], reply: Reply) -> bool:
        """Tell whether a request is new; another one is answered now or with it."""
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
        """Answer a request, as often as it came."""
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
    """The recorded requests: a repeated one is only answered again."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._noted: OrderedDict[tuple[str, str], None] = OrderedDict()

    def first(self, client: str, request_id: str) -> bool:
        """Return whether a request is to be recorded, and count it as recorded."""
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
