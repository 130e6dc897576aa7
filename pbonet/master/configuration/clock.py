"""The time in which a master waits: real, or that of a simulation."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from threading import Event


class Clock(Protocol):
    """Seconds that pass."""

    def now(self) -> float:
        """Return the seconds since some instant."""
        ...

    def wait(self, seconds: float, until: Event) -> bool:
        """Let time pass until it is over or an event is set; return whether it is."""
        ...


class RealClock:
    """That of the machine."""

    def now(self) -> float:
        """Return the seconds since some instant."""
        return time.monotonic()

    def wait(self, seconds: float, until: Event) -> bool:
        """Let time pass until it is over or an event is set; return whether it is."""
        return until.wait(seconds)
