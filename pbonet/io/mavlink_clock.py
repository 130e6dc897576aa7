"""The clock of the other end of a MAVLink link, in terms of our own.

Both ends ask each other for the time (TIMESYNC). Of the last answers the one with the
shortest round trip counts, and is taken to be made when it was asked for: so a time of
the other end never seems later than it was, and by at most a round trip too early.

When the other end starts again, its times seem to be long past until it answers once
more: too old, and never newer than they are.
"""

from __future__ import annotations

from collections import deque

_KEPT = 16
_LONGEST_NS = 1_000_000_000
"""Of a round trip that still tells something, and of a jump that means a restart."""


class PeerClock:
    """Maps times of the other end to `now` of this one, nanoseconds."""

    def __init__(self) -> None:
        self._answers: deque[tuple[int, int]] = deque(maxlen=_KEPT)
        self._last_ns = 0

    @property
    def known(self) -> bool:
        """Whether the other end has answered."""
        return bool(self._answers)

    def learn(self, theirs_ns: int, asked_ns: int, now_ns: int) -> None:
        """Take an answer.

        Args:
            theirs_ns: Time of the other end when it answered.
            asked_ns: Our time when it was asked.
            now_ns: Our time now.
        """
        round_trip = now_ns - asked_ns
        if not 0 <= round_trip <= _LONGEST_NS:
            return
        ahead = theirs_ns - asked_ns
        jumped = self._answers and abs(ahead - self._ahead()) > _LONGEST_NS
        if jumped or theirs_ns < self._last_ns:
            self._answers.clear()  # it has started again
        self._last_ns = theirs_ns
        self._answers.append((round_trip, ahead))

    def ours(self, theirs_ns: int, now_ns: int) -> int:
        """Return our time of a time of the other end, at most `now_ns`.

        It is `now_ns` only as long as the other end has never answered.
        """
        return min(theirs_ns - self._ahead(), now_ns) if self._answers else now_ns

    def _ahead(self) -> int:
        return min(self._answers)[1]
