"""Tasks of the simulator, servers with their events, and their state."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from msgspec import Struct

from .criticality import EXHAUSTED, INSIDE, OUTSIDE
from .servers import ServerKind
from .urgency import NEVER, urgency

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from .outcome import Account

SERVER = 6
"""Criticality of a server with capacity left (section 6.5.2.1)."""
BACKGROUND = 1
"""Criticality of work that is not real-time (section 6.5.2)."""


class PeriodicTask(Struct, frozen=True, kw_only=True):
    """A task that the clock releases."""

    name: str
    period_ns: int
    cost: int | Callable[[], int]
    """CPU nanoseconds of a cycle; asked again at the begin of each when it can be
    called."""
    crit: int = INSIDE
    priority: int = 0
    deadline_ns: int = 0
    """Relative; 0 means the period."""
    offset_ns: int = 0
    """Shifts the grid of releases, which else are multiples of the period."""
    least_ns: int = 0
    """MINC: a cycle that has not started when this can no longer be granted before its
    deadline is not started (section 6.3); 0 begins every one."""
    effective_ns: int = 0
    """E of a soft task: the reserve in each period; 0 for none."""
    drop_crit: int = OUTSIDE
    """Criticality of a soft task that has used E up."""
    begun: Callable[[int, int], None] | None = None
    """Called when a cycle begins, with that instant and the release."""
    done: Callable[[int], None] | None = None
    """Called when a cycle ends, with that instant."""


class ServerTask(Struct, frozen=True, kw_only=True):
    """A task that serves events in the order in which they arrive."""

    name: str
    kind: ServerKind
    arrivals: Iterable[tuple[int, int]]
    """Instant and CPU nanoseconds of each event, in order of time."""
    capacity_ns: int = 0
    period_ns: int = 0
    crit: int = SERVER
    drop_crit: int | None = EXHAUSTED
    """Criticality without capacity; None: it waits for more."""
    priority: int = 0
    offset_ns: int = 0
    more: Callable[[], int] | None = None
    """CPU nanoseconds of the next piece, above 0, of work that never ends: there is one
    from the begin on, and another whenever one is done."""
    begun: Callable[[int, int], None] | None = None
    """Called when an event's processing begins, with that instant and its arrival."""
    done: Callable[[int], None] | None = None
    """Called when it ends, with that instant."""


class Job:
    """The state of one task."""

    __slots__ = (
        "account",
        "active",
        "arrivals",
        "base",
        "begun",
        "budget",
        "coming",
        "cost",
        "crit",
        "deadline",
        "dl",
        "drop",
        "ended",
        "full",
        "gone",
        "index",
        "kind",
        "least",
        "left",
        "limited",
        "more",
        "name",
        "own_dl",
        "period",
        "pieces",
        "priority",
        "queue",
        "rel",
        "slice_end",
        "stamp",
        "started",
        "value",
    )

    def __init__(self, index: int, account: Account, kind: ServerKind | None) -> None:
        self.index, self.account, self.kind = index, account, kind
        self.name = account.name
        self.active = self.begun = self.limited = False
        """Ready to run; its cycle has started; runs on its reserve."""
        self.base = self.crit = account.crit
        self.drop: int | None = None
        self.priority = self.stamp = 0
        self.period, self.deadline = account.period_ns, account.deadline_ns
        self.rel, self.dl, self.own_dl = 0, NEVER, NEVER
        self.left = -1
        """CPU time that the cycle under way still needs; -1 before it begins."""
        self.budget = self.full = self.least = 0
        self.cost: Callable[[], int] | None = None
        self.more: Callable[[], int] | None = None
        self.started: Callable[[int, int], None] | None = None
        self.ended: Callable[[int], None] | None = None
        self.gone = False
        self.value = 0
        self.arrivals: Iterator[tuple[int, int]] = iter(())
        self.coming: tuple[int, int] | None = None
        self.queue: deque[tuple[int, int]] = deque()
        self.pieces: deque[list[int]] = deque()
        """Capacity in use of a sporadic server: when it comes back, and how much."""
        self.slice_end = -1


def check(
    tasks: Iterable[PeriodicTask], servers: Iterable[ServerTask], start_ns: int
) -> None:
    """Raise ValueError for what cannot be simulated."""
    names: set[str] = set()
    everyone: list[PeriodicTask | ServerTask] = [*tasks, *servers]
    for task in everyone:
        if task.name in names:
            msg = f"two tasks are named {task.name}"
            raise ValueError(msg)
        names.add(task.name)
        urgency(task.crit, 0, task.priority)
        if task.drop_crit is not None:
            urgency(task.drop_crit, 0, 0)
        _check_times(task)
    if start_ns < 0:
        msg = f"time cannot begin at {start_ns} ns"
        raise ValueError(msg)


def _check_times(task: PeriodicTask | ServerTask) -> None:
    if isinstance(task, ServerTask):
        refilled = task.kind is not ServerKind.BACKGROUND
        if refilled and not 0 < task.capacity_ns <= task.period_ns:
            msg = f"{task.name}: the capacity is above zero, at most the period"
            raise ValueError(msg)
        return
    cost = 0 if callable(task.cost) else task.cost
    times = (cost, task.deadline_ns, task.effective_ns, task.least_ns)
    if task.period_ns <= 0 or min(times) < 0:
        msg = f"{task.name}: a period is above zero, other times are not below it"
        raise ValueError(msg)


def poisson(
    source: Callable[[], float], rate: float, cost: Callable[[], int], until_ns: int
) -> Iterator[tuple[int, int]]:
    """Yield events of a Poisson process.

    Args:
        source: Returns exponentially distributed numbers of mean 1, such as
            ``functools.partial(random.Random(7).expovariate, 1.0)``.
        rate: Events a second, above zero.
        cost: Returns the CPU nanoseconds of the next event.
        until_ns: No event is later.
    """
    now = 0.0
    while True:
        now += source() / rate * 1e9
        if now > until_ns:
            return
        yield round(now), cost()
