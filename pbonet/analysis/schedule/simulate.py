"""A core in virtual time: who runs when, who misses, for given execution times.

The rules are the runtime's: releases on the grid of the period, tasks ranked by
`urgency`, preemption at every event; a release that finds the last cycle unfinished is
missed, the cycle continues with the deadline of the period that it uses up, and one
that had not started is dropped. Nothing is run twice to catch up. Completions precede
releases at one instant.

Soft tasks and servers (Stewart 1994, 6.4, 6.5) have a reserve of CPU time at their own
criticality and a lower one for when that is used up. Events arrive at servers only.

Nothing here reads a clock; random execution times come from the seed. So a run can be
repeated to the last nanosecond.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush
from typing import TYPE_CHECKING

from .outcome import Account, Outcome, Segment
from .servers import ServerKind
from .simtasks import BACKGROUND, Job, PeriodicTask, ServerTask, check, poisson
from .urgency import NEVER, urgency

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Core", "PeriodicTask", "ServerTask", "poisson", "simulate"]

_RELEASE, _REFILL, _ARRIVAL, _LATEST = range(4)
_KINDS = 4


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
        self._jobs: list[Job] = []
        self._events: list[tuple[int, int]] = []
        self._ready: list[tuple[int, int, int, int]] = []
        self._segments: list[tuple[str, int, int, int]] = []
        check(tasks, servers, start_ns)
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
        job = Job(len(self._jobs), account, None)
        job.priority, job.full = task.priority, task.effective_ns
        job.drop, job.least = task.drop_crit, task.least_ns
        job.started, job.ended = task.begun, task.done
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
        job = Job(len(self._jobs), account, server.kind)
        job.priority, job.drop = server.priority, server.drop_crit
        job.arrivals, job.more = iter(server.arrivals), server.more
        if server.more is not None:
            job.arrivals = iter([(self.now_ns, max(1, server.more()))])
        job.started, job.ended = server.begun, server.done
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

    def _plan(self, when: int, kind: int, job: Job) -> None:
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

    def next_ns(self) -> int:
        """Return when something happens next that others can see; NEVER for never.

        That is now where a cycle is about to begin.
        """
        due = self._events[0][0] if self._events else NEVER
        job = self._top()
        if job is None:
            return due
        if job.left < 0:
            return self.now_ns
        span = min(job.left, job.budget) if job.limited else job.left
        return min(due, self.now_ns + span)

    def step(self) -> None:
        """Process this event and no later one.

        Several cores whose tasks talk to each other are run step by step, always the
        one whose `next_ns` is the least.
        """
        job = self._top()
        if job is not None and job.left < 0:
            self._begin(job)
        else:
            self.run_until(self.next_ns())

    def stop(self, name: str) -> None:
        """Release a task no more; a cycle under way is given up."""
        for job in self._jobs:
            if job.name == name:
                job.gone, job.active = True, False
                job.stamp += 1

    def _top(self) -> Job | None:
        """Return the most urgent task that is ready."""
        ready = self._ready
        while ready and ready[0][3] != self._jobs[ready[0][2]].stamp:
            heappop(ready)
        return self._jobs[ready[0][2]] if ready else None

    def outcome(self) -> Outcome:
        """Return what has happened so far."""
        return Outcome(
            start_ns=self._start,
            end_ns=self.now_ns,
            segments=[Segment(*segment) for segment in self._segments],
            tasks={job.name: job.account for job in self._jobs},
        )

    def _compute(self, job: Job, stop: int) -> None:
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

    def _segment(self, job: Job, start: int, end: int) -> None:
        segments = self._segments
        if segments:
            name, began, last, crit = segments[-1]
            if last == start and name == job.name and crit == job.crit:
                segments[-1] = (name, began, end, crit)
                return
        segments.append((job.name, start, end, job.crit))

    def _begin(self, job: Job) -> None:
        if job.kind is not None:
            release, job.left = job.queue[0]
        else:
            release, job.begun, job.own_dl = job.rel, True, job.dl
            job.left = job.value if job.cost is None else max(0, job.cost())
        if job.started is not None:
            job.left = max(1, job.left)
            job.started(self.now_ns, release)

    def _finish(self, job: Job) -> None:
        account, now = job.account, self.now_ns
        account.cycles += 1
        job.left = -1
        if job.kind is not None:
            account.responses_ns.append(now - job.queue.popleft()[0])
            self._served(job)
        else:
            account.responses_ns.append(now - job.rel)
            if now > job.own_dl:
                account.late += 1
                self._unmet(account, job.own_dl)
            job.active = job.begun = False
            job.stamp += 1
        if job.ended is not None:
            job.ended(now)

    def _rank(self, job: Job) -> None:
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
        elif kind == _ARRIVAL:
            self._arrive(job)
        else:
            self._give_up(job)

    def _release(self, job: Job) -> None:
        if job.gone:
            return
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
        if job.least:
            self._plan(max(now, job.dl - job.least) + 1, _LATEST, job)

    def _give_up(self, job: Job) -> None:
        """The latest start is over: a cycle that has not started is not started."""
        if not job.active or job.begun or self.now_ns + job.least <= job.dl:
            return
        account = job.account
        account.missed += 1
        account.given_up += 1
        self._unmet(account, self.now_ns)
        if self._keep:
            account.misses_ns.append(self.now_ns)
        job.active = False
        job.stamp += 1

    def _exhaust(self, job: Job) -> None:
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

    def _next_arrival(self, job: Job) -> None:
        job.coming = next(job.arrivals, None)
        if job.coming is not None:
            self._plan(max(job.coming[0], self.now_ns), _ARRIVAL, job)

    def _arrive(self, job: Job) -> None:
        job.account.releases += 1
        if self._keep:
            job.account.releases_ns.append(self.now_ns)
        if job.coming is not None:
            job.queue.append(job.coming)
        if not job.active:
            self._serve(job)
        self._next_arrival(job)

    def _serve(self, job: Job) -> None:
        """Make a server ready that has events, if it may run at all."""
        if not job.queue or job.gone:
            return
        job.rel = job.queue[0][0]
        if job.limited or job.kind is ServerKind.BACKGROUND:
            job.crit = job.base
        elif job.drop is not None:
            job.crit = job.drop
        else:
            return
        self._rank(job)

    def _served(self, job: Job) -> None:
        """An event was served to its end."""
        if job.more is not None:
            job.queue.append((self.now_ns, max(1, job.more())))
            job.account.releases += 1
        if job.queue:
            if job.limited and not job.budget:
                self._exhaust(job)
            return
        job.active = False
        job.stamp += 1
        if job.kind is ServerKind.POLLING:
            job.budget = 0
        job.limited = job.limited and job.budget > 0

    def _refill(self, job: Job) -> None:
        """Replenish capacity: all of it, or one piece of a sporadic server."""
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

    def _use(self, job: Job, start: int, end: int) -> None:
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
