"""A task's view of its runtime: time, cycles, criticality, the flag."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable


class IllegalHook(Protocol):
    """Raises or withdraws an entry of the illegal-configuration flag."""

    def __call__(self, cause: str, *, up: bool) -> None:
        """Do so; an empty cause withdraws all of the task's."""


class Schedule(Protocol):
    """A task's scheduling state: time, cycles, criticality."""

    @property
    def now(self) -> int:
        """Release of the present cycle, else the present time; nanoseconds."""
        ...

    @property
    def cyclecount(self) -> int:
        """Cycles executed since the task was turned on."""
        ...

    @property
    def crit(self) -> int:
        """The criticality that the task has now."""
        ...


class Counted:
    """A schedule that its owner keeps up to date, cycle by cycle.

    Args:
        clock: Gives nanoseconds while `release` is None, that is, between cycles.
        crit: The criticality to begin with.
    """

    def __init__(
        self, clock: Callable[[], int] = time.monotonic_ns, crit: int = 0
    ) -> None:
        self.clock = clock
        self.release: int | None = None
        self.cyclecount = 0
        self.crit = crit

    @property
    def now(self) -> int:
        """The release of the present cycle, or the clock's time between cycles."""
        return self.clock() if self.release is None else self.release
