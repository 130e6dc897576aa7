"""The ways to take a message off a queue that all come down to one."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from _typeshed import WriteableBuffer


class Receiving:
    """A queue that has `letter` of its own, and what follows from it."""

    _MOST: ClassVar[int]
    """Bytes of the longest message."""
    letter: Callable[..., tuple[bytes, int] | None]

    def receive(
        self, until_ns: int | None = None, *, priority: int | None = None
    ) -> bytes | None:
        """Take one message; None if none came in time. See `Queue.receive`."""
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
        """Take one message into memory of one's own; return its length."""
        with memoryview(buffer) as view, view.cast("B") as room:
            most = min(len(room), self._MOST)
            found = self.letter(until_ns, priority=priority, most=most)
            if found is None:
                return None
            room[: len(found[0])] = found[0]
        return len(found[0])
