"""Ways to receive a message, all based on `letter`."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from _typeshed import WriteableBuffer


class Receiving:
    """Base of queues that implement `letter` themselves."""

    _MOST: ClassVar[int]
    """Size of the longest message, in bytes."""
    letter: Callable[..., tuple[bytes, int] | None]

    def receive(
        self, until_ns: int | None = None, *, priority: int | None = None
    ) -> bytes | None:
        """Take one message; None at the time-out. See `Queue.receive`."""
        found = self.letter(until_ns, priority=priority)
        return None if found is None else found[0]

    def try_receive(self) -> bytes | None:
        """Take one message if there is one."""
        return self.receive(0)

    def receive_into(
        self,
        buffer: WriteableBuffer,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
    ) -> int | None:
        """Take one message into the caller's memory; return its length in bytes."""
        with memoryview(buffer) as view, view.cast("B") as room:
            most = min(len(room), self._MOST)
            found = self.letter(until_ns, priority=priority, most=most)
            if found is None:
                return None
            room[: len(found[0])] = found[0]
        return len(found[0])
