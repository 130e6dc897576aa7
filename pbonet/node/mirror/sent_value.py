"""A value on its way to the other machines, until all of them have taken it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pbonet.xm.net import key_expressions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import zenoh

VALUE: Final = b"value"
"""Attached to a question that has one value in place of a whole state."""
TAKEN: Final = b"taken"
"""Answers it: the value is in that machine's table. After another answer, such as the
whole state of an agent that does not know it, states are exchanged."""


class SentValue:
    """The answers to one value; called by zenoh's threads.

    Args:
        machines: Those that have the table.
        taken: Called when all of them have taken the value.
        whole: Called when no more answers come, if one must be sent the whole state.
        ended: Called then if one is silent.
    """

    def __init__(
        self,
        machines: Iterable[str],
        taken: Callable[[], None],
        whole: Callable[[], None],
        ended: Callable[[], None],
    ) -> None:
        self._waiting = set(machines)
        self._taken, self._whole, self._ended = taken, whole, ended
        self._done = self._unknown = False

    def replied(self, reply: zenoh.Reply) -> None:
        """Take an answer."""
        if reply.ok is None:
            return
        if reply.ok.payload.to_bytes() != TAKEN:
            self._unknown = True
            return
        self._waiting.discard(key_expressions.last(str(reply.ok.key_expr)))
        if not (self._waiting or self._unknown or self._done):
            self._done = True
            self._taken()

    def end(self) -> None:
        """Note that no more answers come."""
        if self._unknown:
            self._whole()
        elif not self._done:
            self._ended()
