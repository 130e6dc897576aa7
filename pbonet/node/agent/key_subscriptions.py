"""Network keys whose messages become events of tasks (`events` of agent.toml).

The agent subscribes to a key and passes messages to its RTPU process, which puts them
into a queue of that RTPU (`network_queues`). So a server or synchronous task can wait
for a camera, an operator or a planner as for a local task, without any network code in
its process.
"""

from __future__ import annotations

import contextlib
import threading
from collections import Counter, deque
from typing import TYPE_CHECKING

from pbonet.errors import NodeError, Severity
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import LONGEST

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import zenoh

WAITING = 256
"""Maximum number of waiting messages; the oldest are dropped first."""


class KeySubscriptions:
    """Subscribes to keys and passes on their messages.

    Zenoh's callbacks must return at once, so a thread passes the messages on.

    Args:
        session: The agent's session.
        keys: Key expressions by queue.
        hand_on: Called with a message for the RTPU process, or with a note about a
            message that was too long for any queue.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Mapping[str, str],
        hand_on: Callable[[rtpu_messages.Arrived | rtpu_messages.Note], None],
    ) -> None:
        self._hand_on = hand_on
        self._waiting: deque[rtpu_messages.Arrived | rtpu_messages.Note] = deque(
            maxlen=WAITING
        )
        self._too_long: Counter[str] = Counter()
        self._news = threading.Semaphore(0)
        self._over = False
        self._subscribers = [
            session.declare_subscriber(key, self._listener(queue))
            for queue, key in keys.items()
        ]
        self._thread = threading.Thread(
            target=self._work, name="pbonet keys", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End all subscriptions."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._over = True
        self._news.release()
        self._thread.join()

    def _listener(self, queue: str) -> Callable[[zenoh.Sample], None]:
        def on_sample(sample: zenoh.Sample) -> None:
            size = len(sample.payload)
            if size > LONGEST:
                self._refuse(queue, size)
                return
            if more := self._too_long.pop(queue, 1) - 1:
                self._report(
                    f"{more} more messages for the queue {queue} were too long"
                )
            self._put(rtpu_messages.Arrived(queue, bytes(sample.payload)))

        return on_sample

    def _refuse(self, queue: str, size: int) -> None:
        """Count a message that is too long for any queue; report the first one."""
        self._too_long[queue] += 1
        if self._too_long[queue] == 1:
            self._report(
                f"a message for the queue {queue} is too long and was dropped "
                f"(expected at most {LONGEST} bytes) (got {size}); let its sender "
                "divide it"
            )

    def _report(self, text: str) -> None:
        self._put(rtpu_messages.Note(int(Severity.WARNING), "XM_TOO_LONG", text))

    def _put(self, message: rtpu_messages.Arrived | rtpu_messages.Note) -> None:
        self._waiting.append(message)
        self._news.release()

    def _work(self) -> None:
        while True:
            self._news.acquire()
            if self._over:
                return
            with contextlib.suppress(IndexError, NodeError):  # dropped, or no process
                self._hand_on(self._waiting.popleft())
