"""Events of one RTPU: numbered, kept for late requests, passed to the publisher.

Every error, warning, state change and line of output becomes an event. The RTPU process
keeps them, so that the numbers continue when its agent is restarted.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from typing import TYPE_CHECKING

from pbonet.errors import Severity
from pbonet.pbo import Signal
from pbonet.xm.net import Event

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

KEPT = 4000
LONGEST_TEXT = 8000


class EventLog:
    """The last events of one RTPU.

    Args:
        rtpu: Its name, added to every event.
        clock_ns: CLOCK_MONOTONIC in nanoseconds; tests supply their own.
        wall: Seconds since the epoch, for display.
    """

    def __init__(
        self,
        rtpu: str,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._rtpu = rtpu
        self._clock_ns = clock_ns
        self._wall = wall
        self._kept: deque[Event] = deque(maxlen=KEPT)
        self._next = 1
        self._counts: Counter[tuple[str, str, str]] = Counter()
        self.publish: Callable[[Event], None] | None = None
        self.state_of: Callable[[str, str], str] | None = None
        """Returns the state of a subsystem's task."""

    @property
    def next(self) -> int:
        """The number of the next event."""
        return self._next

    def now_ns(self) -> int:
        """Return the time that an event would have now."""
        return self._clock_ns()

    def add(
        self,
        severity: Severity,
        code: str,
        text: str,
        *,
        subsystem: str = "",
        task: str = "",
        cycle: int = 0,
        bits: int = 0,
        errnum: int = 0,
        place: str = "",
    ) -> Event:
        """Number, keep and publish an event."""
        if len(text) > LONGEST_TEXT:
            text = f"{text[:LONGEST_TEXT]} ... ({len(text) - LONGEST_TEXT} more)"
        event = Event(
            n=self._next,
            time=self._clock_ns(),
            wall=self._wall(),
            severity=int(severity),
            code=code,
            rtpu=self._rtpu,
            subsystem=subsystem,
            task=task,
            cycle=cycle,
            bits=bits,
            errnum=errnum,
            place=place,
            state=self.state_of(subsystem, task) if task and self.state_of else "",
            text=text,
        )
        self._next += 1
        self.count(code, subsystem=subsystem, task=task)
        self._kept.append(event)
        if self.publish is not None:
            self.publish(event)
        return event

    def count(
        self, code: str, number: int = 1, *, subsystem: str = "", task: str = ""
    ) -> None:
        """Count events; suppressed ones are only counted."""
        self._counts[subsystem, task, code] += number

    def counts(self) -> list[tuple[str, str, str, int]]:
        """Return how often each event came: subsystem, task, code and count."""
        return [(*key, count) for key, count in self._counts.items()]

    def forget(self, subsystem: str) -> None:
        """Forget the counts of a subsystem."""
        for key in [key for key in self._counts if key[0] == subsystem]:
            del self._counts[key]

    def since(self, number: int, limit: int = KEPT) -> list[Event]:
        """Return the kept events from `number` on, oldest first."""
        if not self._kept or number >= self._next:
            return []
        skip = max(0, number - self._kept[0].n)
        return [self._kept[i] for i in range(skip, min(len(self._kept), skip + limit))]


def by_task(
    counts: Iterable[tuple[str, str, str, int]], subsystem: str = ""
) -> dict[str, dict[str, int]]:
    """Return how often each code came, by task; ``""`` is the RTPU itself.

    Args:
        counts: As `EventLog.counts` returns them.
        subsystem: The subsystem of the tasks; empty: all subsystems.
    """
    found: dict[str, dict[str, int]] = {}
    for whose, task, code, count in counts:
        if subsystem and whose not in {"", subsystem}:
            continue
        codes = found.setdefault(task, {})
        codes[code] = codes.get(code, 0) + count
    return found


class LineBudget:
    """Limits the lines of a source to a rate with a burst.

    Suppressed lines are counted, and the count is reported once lines pass again.
    """

    def __init__(self, rate: float = 20.0, burst: float = 100.0) -> None:
        self._rate = rate
        self._burst = burst
        self._tokens = burst
        self._time_ns = 0
        self.suppressed = 0

    def take(self, now_ns: int) -> bool:
        """Return whether one more line passes at `now_ns`."""
        passed = (now_ns - self._time_ns) * 1e-9 * self._rate
        self._tokens = min(self._burst, self._tokens + passed)
        self._time_ns = now_ns
        if self._tokens >= 1.0:
            self._tokens -= 1.0
            return True
        self.suppressed += 1
        return False

    def take_suppressed(self) -> int:
        """Return how many lines were suppressed since the last call."""
        count, self.suppressed = self.suppressed, 0
        return count


def severity(bits: int) -> Severity:
    """Return the severity of signals."""
    if bits & (Signal.ERROR | Signal.SHUTDOWN):
        return Severity.ERROR
    return Severity.WARNING if bits & Signal.WARNING else Severity.INFO
