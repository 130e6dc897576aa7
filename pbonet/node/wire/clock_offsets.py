"""The offsets of other machines' clocks from this one's.

The shortest of the last round trips gives the best estimate: if both directions take
equally long, the answer was made in the middle of the round trip; the error is at most
half of it (Cristian 1989). A clock belongs to a machine until that boots again, so its
estimate outlives interruptions of the network, and loses certainty with time.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Final, NamedTuple

WINDOW_NS: Final = 8_000_000_000
"""How long a round trip is preferred to longer ones."""
DRIFT: Final = 5e-4
"""How much faster one clock may run than another."""
MARGIN_NS: Final = 1_000_000
"""By how much more than its possible error an offset must be wrong to be rejected."""
MOST: Final = 256
"""Maximum number of machines that are remembered."""


class RoundTrip(NamedTuple):
    """One round trip."""

    seconds: float
    offset_ns: int
    """By how much the other clock is ahead."""
    at_ns: int
    """When it ended, by this machine's clock."""


def round_trip(begin_ns: int, end_ns: int, theirs_ns: int) -> RoundTrip:
    """Return a round trip with an answer that was made at `theirs_ns` there."""
    middle = (begin_ns + end_ns) // 2
    return RoundTrip((end_ns - begin_ns) * 1e-9, theirs_ns - middle, end_ns)


class RoundTrips:
    """The last round trips to one agent or machine."""

    def __init__(self) -> None:
        self._trips: deque[RoundTrip] = deque(maxlen=64)
        """Each is longer than those before it, which end to count earlier."""

    def add(self, trip: RoundTrip) -> None:
        """Add a round trip."""
        trips = self._trips
        while trips and trips[-1].seconds >= trip.seconds:
            trips.pop()
        trips.append(trip)
        while trips[0].at_ns < trip.at_ns - WINDOW_NS:
            trips.popleft()

    @property
    def best(self) -> RoundTrip | None:
        """The shortest of the last ones; None before the first."""
        return self._trips[0] if self._trips else None


class Clock(NamedTuple):
    """An estimate of another machine's clock."""

    ahead_ns: int
    """By how much it is ahead, at most: data seem rather too old than too new."""
    error_ns: int
    """By how much more than the true way data may seem to be too new."""

    def way(self, sent_ns: int, now_ns: int) -> int | None:
        """Return for how many ns something was under way that arrives now.

        Args:
            sent_ns: When it was sent, by the other clock.
            now_ns: Now, by this machine's clock.

        Returns:
            None if it would have been sent after its arrival: the clocks are not as
            they were, for example because one of the machines was suspended.
        """
        way = now_ns - (sent_ns - self.ahead_ns)
        return None if way < -self.error_ns else max(way, 0)


class ClockOffsets:
    """The clocks of other machines, by the identity of each."""

    def __init__(self) -> None:
        self._trips: dict[str, RoundTrips] = {}
        self._guard = threading.Lock()

    def add(self, machine: str, trip: RoundTrip) -> None:
        """Add a measurement; may be called from any thread."""
        with self._guard:
            trips = self._trips.pop(machine, None) or RoundTrips()
            trips.add(trip)
            self._trips[machine] = trips
            while len(self._trips) > MOST:
                self._trips.pop(next(iter(self._trips)))

    def clock(self, machine: str, now_ns: int) -> Clock | None:
        """Return what is known of a machine's clock; may be called from any thread."""
        with self._guard:
            trips = self._trips.get(machine)
            best = trips.best if trips is not None else None
        if best is None:
            return None
        drift = round(max(now_ns - best.at_ns, 0) * DRIFT)
        error = round(best.seconds * 5e8) + MARGIN_NS
        return Clock(best.offset_ns + drift, error)
