"""A core in virtual time: who runs when, who misses, for given execution times.

The rules are the runtime's (`pbonet.sched.dispatch`): releases on the grid of the
period, tasks ranked by `urgency`, preemption at every event; a release that finds the
last cycle unfinished is missed, the cycle goes on with the deadline of the period that
it uses up, and one that had not begun is dropped. Nothing is run twice to catch up.
Completions go before releases at one instant.

Soft tasks and servers (Stewart 1994, 6.4, 6.5) have a reserve of CPU time at their own
criticality and a lower one for when that is used up. Events arrive at servers only.

Nothing here reads a clock; random execution times come from the seed. So a run can be
repeated to the last nanosecond.
"""

from __future__ import annotations

from collections import deque
from heapq import heapify, heappop, heappush
from typing import TYPE_CHECKING

from msgspec import Struct

from .criticality import INSIDE, OUTSIDE
from .outcome import Account, Outcome, Segment
from .servers import ServerKind
from .urgency import NEVER, urgency

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

SERVER = 6
"""Criticality of a server with capacity left (section 6.5.2.1)."""
EXHAUSTED = 4
"""Criticality of a server that has used its capacity up."""
BACKGROUND = 1
"""Criticality of work that is not real-time (section 6.5.2)."""
_RELEASE, _REFILL, _ARRIVAL = range(3)
_KINDS = 3


class PeriodicTask(Struct, frozen=True, kw_only=True):
    """A task that the clock releases."""

    name: str
    period_ns: int
    cost: int | Callable[[], int]
    """CPU nanoseconds of a cycle; asked anew at the begin of each when it can be
    called."""
    crit: int = INSIDE
    priority: int = 0
    deadline_ns: int = 0
    """Relative; 0 means the period."""
    offset_ns: int = 0
    """Shifts the grid of releases, which else are multiples of the period."""
    effective_ns: int = 0
    """E of a soft task: the reserve in each period; 0 for none."""
    drop_crit: int = OUTSIDE
    """Criticality of a soft task that has used E up."""


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


class _Job:
    """The state of one task."""

    __slots__ = (
        "account", "active", "arrivals", "base", "begun", "budget", "coming", "cost",
        "crit", "deadline", "dl", "drop", "full", "index", "kind", "left", "limited",
        "name", "own_dl", "period", "pieces", "priority", "queue", "rel", "slice_end",
        "stamp", "value",
    )  # fmt: skip

    def __init__(self, index: int, account: Account, kind: ServerKind | None) -> None:
        self.index, self.account, self.kind = index, account, kind
        self.name = account.name
        self.active = self.begun = self.limited = False
        """Ready to run; its cycle has begun; runs on its reserve."""
        self.base = self.crit = account.crit
        self.drop: int | None = None
        self.priority = self.stamp = 0
        self.period, self.deadline = account.period_ns, account.deadline_ns
        self.rel, self.dl, self.own_dl = 0, NEVER, NEVER
        self.left = -1
        """CPU time that the cycle under way still needs; -1 before it begins."""
        self.budget = self.full = 0
        self.cost: Callable[[], int] | None = None
        self.value = 0
        self.arrivals: Iterator[tuple[int, int]] = iter(())
        self.coming: tuple[int, int] | None = None
        self.queue: deque[tuple[int, int]] = deque()
        self.pieces: deque[list[int]] = deque()
        """Capacity in use of a sporadic server: when it comes back, and how much."""
        self.slice_end = -1


class Core:
    """One core with its tasks.

    Args:
        tasks: The periodic tasks, in the order that breaks the last ties.
        servers: The servers; they come after the tasks in that order.
        start_ns: Where time begins, not below 0.
        keep: Keep segments and instants, not only the counts and response times.

    Raises:
        ValueError: Two tasks have one name, or a value is out of its range.
    """

    def __init__(
        self,
        tasks: Sequence[PeriodicTask],
        servers: Sequence[ServerTask] = (),
        *,
        start_ns: int = 0,
        keep: bool = True,
    ) -> None:
        self.now_ns = self._start = start_ns
        self._keep = keep
        self._jobs: list[_Job] = []
        self._events: list[tuple[int, int]] = []
        self._ready: list[tuple[int, int, int, int]] = []
        self._segments: list[tuple[str, int, int, int]] = []
        _check(tasks, servers, start_ns)
        for task in tasks:
            self._add_task(task)
        for server in servers:
            self._add_server(server)
        heapify(self._events)

    def _add_task(self, task: PeriodicTask) -> None:
        account = Account(
            name=task.name,
            crit=task.crit,
            period_ns=task.period_ns,
            deadline_ns=task.deadline_ns or task.period_ns,
            misses_ns=[], releases_ns=[], responses_ns=[],
        )  # fmt: skip
        job = _Job(len(self._jobs), account, None)
        job.priority, job.full = task.priority, task.effective_ns
        job.drop = task.drop_crit
        if callable(task.cost):
            job.cost = task.cost
        else:
            job.value = task.cost
        self._jobs.append(job)
        self._plan(self._first(task), _RELEASE, job)

    def _add_server(self, server: ServerTask) -> None:
        background = server.kind is ServerKind.BACKGROUND
        account = Account(
            name=server.name,
            crit=BACKGROUND if background else server.crit,
            period_ns=server.period_ns,
            deadline_ns=0,
            server=True,
            misses_ns=[], releases_ns=[], responses_ns=[],
        )  # fmt: skip
        job = _Job(len(self._jobs), account, server.kind)
        job.priority, job.drop = server.priority, server.drop_crit
        job.arrivals = iter(server.arrivals)
        self._jobs.append(job)
        if server.kind is ServerKind.POLLING:
            job.drop = None
        if not background:
            job.full = server.capacity_ns
            job.limited = server.kind is not ServerKind.POLLING
            job.budget = job.full if job.limited else 0
            if server.kind is not ServerKind.SPORADIC:
                job.dl = self._first(server)
                self._plan(job.dl, _REFILL, job)
        self._next_arrival(job)

    def _first(self, task: PeriodicTask | ServerTask) -> int:
        """Return the first instant of the task's grid that is not over."""
        behind = (task.offset_ns - self._start) % task.period_ns
        return self._start + behind

    def _plan(self, when: int, kind: int, job: _Job) -> None:
        heappush(self._events, (when, job.index * _KINDS + kind))

    # -- time passes ------------------------------------------------------------------

    def run_until(self, until_ns: int) -> None:
        """Let time pass up to `until_ns`; events at that instant still happen."""
        events, ready, jobs = self._events, self._ready, self._jobs
        while True:
            due = events[0][0] if events else until_ns + 1
            if ready and self.now_ns < due and self.now_ns < until_ns:
                entry = ready[0]
                job = jobs[entry[2]]
                if entry[3] == job.stamp:
                    self._compute(job, min(due, until_ns))
                else:
                    heappop(ready)
                continue
            self.now_ns = max(self.now_ns, min(due, until_ns))
            if due > until_ns:
                return
            while events and events[0][0] == due:
                self._happen(heappop(events)[1])

    def outcome(self) -> Outcome:
        """Return what has happened so far."""
        return Outcome(
            start_ns=self._start,
            end_ns=self.now_ns,
            segments=[Segment(*segment) for segment in self._segments],
            tasks={job.name: job.account for job in self._jobs},
        )

    def _compute(self, job: _Job, stop: int) -> None:
        """Run the most urgent task until its cycle ends, its reserve, or `stop`."""
        if job.left < 0:
            self._begin(job)
        start = self.now_ns
        span = job.left
        if job.limited and job.budget < span:
            span = job.budget
        end = min(start + span, stop)
        used = end - start
        self.now_ns = end
        job.left -= used
        job.account.cpu_ns += used
        if used and self._keep:
            self._segment(job, start, end)
        if job.limited:
            job.budget -= used
            if job.kind is ServerKind.SPORADIC:
                self._use(job, start, end)
        if not job.left:
            self._finish(job)
        elif job.limited and not job.budget:
            self._exhaust(job)

    def _segment(self, job: _Job, start: int, end: int) -> None:
        segments = self._segments
        if segments:
            name, began, last, crit = segments[-1]
            if last == start and name == job.name and crit == job.crit:
                segments[-1] = (name, began, end, crit)
                return
        segments.append((job.name, start, end, job.crit))

    def _begin(self, job: _Job) -> None:
        if job.kind is not None:
            job.left = job.queue[0][1]
            return
        job.begun = True
        job.own_dl = job.dl
        job.left = job.value if job.cost is None else max(0, job.cost())

    def _finish(self, job: _Job) -> None:
        account, now = job.account, self.now_ns
        account.cycles += 1
        job.left = -1
        if job.kind is not None:
            account.responses_ns.append(now - job.queue.popleft()[0])
            self._served(job)
            return
        account.responses_ns.append(now - job.rel)
        if now > job.own_dl:
            account.late += 1
            self._unmet(account, job.own_dl)
        job.active = job.begun = False
        job.stamp += 1

    def _rank(self, job: _Job) -> None:
        """Put the task into the queue of ready ones where it belongs now."""
        job.active = True
        job.stamp += 1
        rank = -urgency(job.crit, job.dl, job.priority)
        heappush(self._ready, (rank, job.rel, job.index, job.stamp))

    @staticmethod
    def _unmet(account: Account, when: int) -> None:
        if account.first_miss_ns < 0:
            account.first_miss_ns = when

    # -- what happens at instants -----------------------------------------------------

    def _happen(self, code: int) -> None:
        index, kind = divmod(code, _KINDS)
        job = self._jobs[index]
        if kind == _RELEASE:
            self._release(job)
        elif kind == _REFILL:
            self._refill(job)
        else:
            self._arrive(job)

    def _release(self, job: _Job) -> None:
        now, account = self.now_ns, job.account
        account.releases += 1
        if self._keep:
            account.releases_ns.append(now)
        if job.active:
            account.missed += 1
            self._unmet(account, job.dl)
            if self._keep:
                account.misses_ns.append(now)
        if not job.begun:
            job.rel = now
        job.dl = now + job.deadline
        if job.full:
            job.budget, job.limited, job.crit = job.full, True, job.base
        self._rank(job)
        self._plan(now + job.period, _RELEASE, job)

    def _exhaust(self, job: _Job) -> None:
        """The reserve is used up: E of a soft task, the capacity of a server."""
        job.account.overruns += 1
        job.limited = False
        if job.drop is None:
            job.active = False
            job.stamp += 1
        else:
            job.crit = job.drop
            self._rank(job)

    # -- servers ----------------------------------------------------------------------

    def _next_arrival(self, job: _Job) -> None:
        job.coming = next(job.arrivals, None)
        if job.coming is not None:
            self._plan(max(job.coming[0], self.now_ns), _ARRIVAL, job)

    def _arrive(self, job: _Job) -> None:
        job.account.releases += 1
        if self._keep:
            job.account.releases_ns.append(self.now_ns)
        if job.coming is not None:
            job.queue.append(job.coming)
        if not job.active:
            self._serve(job)
        self._next_arrival(job)

    def _serve(self, job: _Job) -> None:
        """Make a server ready that has events, if it may run at all."""
        if not job.queue:
            return
        job.rel = job.queue[0][0]
        if job.limited or job.kind is ServerKind.BACKGROUND:
            job.crit = job.base
        elif job.drop is not None:
            job.crit = job.drop
        else:
            return
        self._rank(job)

    def _served(self, job: _Job) -> None:
        """An event was served to its end."""
        if job.queue:
            if job.limited and not job.budget:
                self._exhaust(job)
            return
        job.active = False
        job.stamp += 1
        if job.kind is ServerKind.POLLING:
            job.budget = 0
        job.limited = job.limited and job.budget > 0

    def _refill(self, job: _Job) -> None:
        """Give capacity back: the whole of it, or one piece of a sporadic server."""
        now = self.now_ns
        if job.kind is ServerKind.SPORADIC:
            job.budget += job.pieces.popleft()[1]
            if not job.pieces:
                job.slice_end = -1
            back = not job.limited
        else:
            job.dl = now + job.period
            self._plan(job.dl, _REFILL, job)
            back = job.kind is ServerKind.DEFERRABLE or bool(job.queue)
            job.budget = job.full if back else 0
        if back:
            job.limited = True
            self._serve(job)

    def _use(self, job: _Job, start: int, end: int) -> None:
        """Note that a sporadic server ran on its capacity.

        A stretch without a break comes back whole, one period after it began.
        """
        if start == end:
            return
        if job.slice_end == start:
            job.pieces[-1][1] += end - start
        else:
            job.pieces.append([start + job.period, end - start])
            self._plan(start + job.period, _REFILL, job)
        job.slice_end = end


def _check(
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
    if task.period_ns <= 0 or min(cost, task.deadline_ns, task.effective_ns) < 0:
        msg = f"{task.name}: a period is above zero, other times are not below it"
        raise ValueError(msg)


def simulate(
    tasks: Sequence[PeriodicTask],
    servers: Sequence[ServerTask] = (),
    *,
    until_ns: int,
    start_ns: int = 0,
    keep: bool = True,
) -> Outcome:
    """Run tasks on one core and return what happened.

    Args:
        tasks: The periodic tasks.
        servers: Servers and their events.
        until_ns: Where time ends; releases at that instant still count, so that the
            deadlines that lie there are judged.
        start_ns: Where it begins.
        keep: As for `Core`.

    Raises:
        ValueError: As for `Core`.
    """
    core = Core(tasks, servers, start_ns=start_ns, keep=keep)
    core.run_until(until_ns)
    return core.outcome()


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
