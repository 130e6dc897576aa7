"""Puts what the agent receives into queues of the RTPU; see `key_subscriptions`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet import xm
from pbonet.errors import Severity, XmDestroyedError, XmError

if TYPE_CHECKING:
    from pbonet.node.wire import EventLog, rtpu_messages


class NetworkQueues:
    """Queues that the network fills; the newest messages stay.

    Args:
        events: Takes reports of what cannot be put in.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._queues: dict[str, xm.Queue] = {}
        self._told: set[str] = set()

    def put(self, message: rtpu_messages.Arrived) -> None:
        """Put a message into its queue; one that a module destroyed is made again."""
        try:
            try:
                self._send(message)
            except XmDestroyedError:
                self._queues.pop(message.queue).close()
                self._send(message)
        except XmError as error:
            if message.queue not in self._told:
                self._told.add(message.queue)
                self._events.add(Severity.WARNING, error.code, str(error))
        else:
            self._told.discard(message.queue)

    def _send(self, message: rtpu_messages.Arrived) -> None:
        queue = self._queues.get(message.queue)
        if queue is None:
            queue = self._queues[message.queue] = xm.queue(message.queue)
        queue.send(message.data, full=xm.Full.DROP_OLDEST)

    def close(self) -> None:
        """Let the queues go."""
        while self._queues:
            self._queues.popitem()[1].close()
