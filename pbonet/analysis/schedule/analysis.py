"""Do these tasks keep their deadlines? (Stewart 1994, section 6.2).

Tests for MUF, EDF and RM, beside one another, without and with aperiodic servers above
the tasks. All take integer nanoseconds and reckon exactly, so that a set that uses the
core to its last nanosecond is not judged by a rounding error. What they promise holds
for any phases of the releases.

`servers` has the closed formulas (equations 10 to 26); here are the tests
that know every period, which never promise what cannot be kept, and accept more.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from .criticality import liu_layland
from .servers import Server, ServerKind

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    import numpy as np

CHUNK = 1 << 16
"""Deadlines that the demand test checks in one go."""
MOST = 1 << 20
"""Deadlines after which it gives up; the set then counts as not proven."""


STEP = 1000
"""Nanoseconds between capacities that `largest_server` distinguishes."""


class Demand(Struct, frozen=True, kw_only=True):
    """A periodic task in the form the tests use."""

    name: str
    period_ns: int
    cost_ns: int
    """Worst CPU time a cycle: C, or E of a soft task (section 6.4)."""
    deadline_ns: int = 0
    """Relative to the release, at most the period; 0 means the period."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: A value is out of its range.
        """
        if self.period_ns <= 0:
            msg = f"{self.name}: period {self.period_ns} ns is not above zero"
            raise ValueError(msg)
        if self.cost_ns < 0:
            msg = f"{self.name}: execution time {self.cost_ns} ns is below zero"
            raise ValueError(msg)
        if not 0 <= self.deadline_ns <= self.period_ns:
            msg = f"{self.name}: deadline {self.deadline_ns} ns is beyond the period"
            raise ValueError(msg)

    @property
    def due_ns(self) -> int:
        """The relative deadline."""
        return self.deadline_ns or self.period_ns

    @property
    def share(self) -> Fraction:
        """The utilization of this task, exactly."""
        return Fraction(self.cost_ns, self.period_ns)


def utilization(tasks: Iterable[Demand | Server]) -> float:
    """Return the share of the core that the tasks may use: equation 8."""
    return float(_sum(tasks))


def _sum(tasks: Iterable[Demand | Server]) -> Fraction:
    total = Fraction(0)
    for task in tasks:
        if isinstance(task, Server):
            total += Fraction(task.capacity_ns, task.period_ns)
        else:
            total += task.share
    return total


def by_period(tasks: Iterable[Demand]) -> list[Demand]:
    """Return the tasks from shortest to longest period, names breaking ties."""
    return sorted(tasks, key=lambda task: (task.period_ns, task.name))


# -- rate monotonic -------------------------------------------------------------------


def rm_bound_holds(tasks: Sequence[Demand]) -> bool:
    """Return whether equation 9 promises the deadlines of all tasks under RM.

    It is sufficient only: sets beyond it may be schedulable (`rm_schedulable`). It
    speaks of deadlines at the end of the period.
    """
    if not tasks:
        return True
    implicit = all(task.due_ns == task.period_ns for task in tasks)
    total = _sum(tasks)
    return implicit and (
        total <= 1 if len(tasks) == 1 else total <= Fraction(liu_layland(len(tasks)))
    )


def response_time(
    task: Demand, above: Iterable[Demand], servers: Iterable[Server] = ()
) -> int | None:
    """Return the longest time from a release to the cycle's end, fixed priorities.

    The least solution of ``R = C + sum(ceil(R / T_j) * C_j)``, with what the servers
    delay added: exact for the worst phases.

    Args:
        task: The one asked about.
        above: All tasks that may go first: higher and equal priorities.
        servers: Servers at higher priority.

    Returns:
        Nanoseconds, or None when the deadline can be missed.
    """
    others, reserved = list(above), list(servers)
    response, last = task.cost_ns, -1
    while response != last and response <= task.due_ns:
        last = response
        response = task.cost_ns
        for other in others:
            response += -(-last // other.period_ns) * other.cost_ns
        for server in reserved:
            response += server.delays_ns(last)
    return response if response <= task.due_ns else None


def rm_response_times(
    tasks: Iterable[Demand], servers: Iterable[Server] = ()
) -> dict[str, int | None]:
    """Return the longest response of every task under RM, None where it may miss.

    Tasks of equal period may each go first, whatever breaks the tie at run time.
    """
    tasks, servers = list(tasks), list(servers)
    return {
        task.name: response_time(
            task,
            [t for t in tasks if t.period_ns <= task.period_ns and t is not task],
            servers,
        )
        for task in by_period(tasks)
    }


def rm_schedulable(tasks: Iterable[Demand], servers: Iterable[Server] = ()) -> bool:
    """Return whether RM keeps every deadline: exact, beside equation 9."""
    return None not in rm_response_times(tasks, servers).values()


def level_response_times(
    tasks: Iterable[Demand], levels: Mapping[str, int], servers: Iterable[Server] = ()
) -> dict[str, int | None]:
    """Return the longest response of every task under fixed criticalities.

    RM gives all rates of one band one criticality (section 4.5.1), and the deadline
    ranks within it. So every other task of the band may go first.

    Args:
        tasks: All periodic tasks of one RTPU.
        levels: The criticality of each, by name.
        servers: Servers above all of them.

    Returns:
        Nanoseconds by name, None where this does not prove that the deadline is kept.
    """
    tasks, servers = list(tasks), list(servers)
    return {
        task.name: response_time(
            task,
            [t for t in tasks if t is not task and levels[t.name] >= levels[task.name]],
            servers,
        )
        for task in by_period(tasks)
    }


def level_guaranteed(
    tasks: Iterable[Demand], levels: Mapping[str, int], servers: Iterable[Server] = ()
) -> set[str]:
    """Return the tasks that never miss under fixed criticalities.

    Beside what `level_response_times` proves: the tasks of a band are ranked by their
    deadlines, below tasks that take no more from any window than a server would.
    """
    tasks, servers = list(tasks), list(servers)
    proven = level_response_times(tasks, levels, servers)
    found = {name for name, response in proven.items() if response is not None}
    for level in {levels[task.name] for task in tasks}:
        above = [task for task in tasks if levels[task.name] > level]
        band = [task for task in tasks if levels[task.name] == level]
        if all(task.cost_ns <= task.period_ns for task in above) and edf_schedulable(
            band, [*servers, *map(_as_server, above)]
        ):
            found.update(task.name for task in band)
    return found


def _as_server(task: Demand) -> Server:
    return Server(
        name=task.name,
        kind=ServerKind.SPORADIC,
        capacity_ns=task.cost_ns,
        period_ns=task.period_ns,
    )


# -- earliest deadline first, and the critical set of MUF -----------------------------


def edf_schedulable(tasks: Iterable[Demand], servers: Iterable[Server] = ()) -> bool:
    """Return whether EDF keeps every deadline below servers of higher criticality.

    Without servers, and with deadlines at the period's end, that is U <= 1 (section
    6.2.2). Otherwise the demand of every window that ends in a deadline has to fit in
    what the servers leave of it (equation 17, with the availability worked out and not
    bounded). A set whose test would need more than `MOST` deadlines is not proven.
    """
    tasks = [task for task in tasks if task.cost_ns]
    servers = [server for server in servers if server.capacity_ns]
    total = _sum(tasks) + _sum(servers)
    if total > 1:
        return False
    if not servers and all(task.due_ns == task.period_ns for task in tasks):
        return True
    if not tasks:
        return True
    last = _horizon(tasks, servers, total)
    if sum(1 + last // task.period_ns for task in tasks) > MOST:
        return False
    step = max(1, last // max(1, _points(tasks, last) // CHUNK))
    return all(
        _fits(tasks, servers, low, min(low + step, last))
        for low in range(0, last + 1, step)
    )


def _points(tasks: Iterable[Demand], last: int) -> int:
    return sum(1 + last // task.period_ns for task in tasks)


def _horizon(tasks: list[Demand], servers: list[Server], total: Fraction) -> int:
    """Return a window beyond which no demand can be too much for the first time."""
    cycle = math.lcm(*(t.period_ns for t in tasks), *(s.period_ns for s in servers))
    if total == 1:
        return 2 * cycle
    early = sum(float(t.share) * (t.period_ns - t.due_ns) for t in tasks)
    excess = early + sum(server.excess_ns for server in servers)
    longest = max((task.due_ns for task in tasks), default=0)
    return max(longest, min(2 * cycle, math.ceil(excess / float(1 - total)) + 1))


def _fits(tasks: list[Demand], servers: list[Server], low: int, high: int) -> bool:
    """Test the deadlines of one stretch, both ends included."""
    import numpy as np  # most sets are judged without it

    ends: list[np.ndarray] = []
    for task in tasks:
        first = max(0, -(-(low - task.due_ns) // task.period_ns))
        stop = (high - task.due_ns) // task.period_ns
        ends.append(
            np.arange(first, stop + 1, dtype=np.int64) * task.period_ns + task.due_ns
        )
    windows = np.unique(np.concatenate(ends))
    needed = np.zeros(windows.shape, dtype=np.int64)
    for task in tasks:
        cycles = (windows - task.due_ns) // task.period_ns + 1
        needed += np.maximum(cycles, 0) * task.cost_ns
    for server in servers:
        needed += _taken(server, windows)
    return bool((needed <= windows).all())


def _taken(server: Server, windows: np.ndarray) -> np.ndarray:
    """Return `Server.taken_ns` of many windows."""
    import numpy as np

    first = np.zeros_like(windows)
    if server.kind is ServerKind.DEFERRABLE:
        first = np.minimum(windows, server.capacity_ns)
    rest = windows - first
    whole, part = rest // server.period_ns, rest % server.period_ns
    taken: np.ndarray = (
        first + whole * server.capacity_ns + np.minimum(part, server.capacity_ns)
    )
    return taken


def critical_set(
    tasks: Iterable[Demand], servers: Iterable[Server] = (), *, limit: float = 1.0
) -> tuple[str, ...]:
    """Return the critical set of MUF: the first N tasks that never miss (6.2.3).

    N is the largest number of tasks, shortest periods first, whose utilization and the
    servers' together stay within `limit`, and which EDF schedules below the servers.

    Args:
        tasks: All periodic tasks of one RTPU.
        servers: Servers with criticality 6.
        limit: Share of the core that may be used, above 0, at most 1.

    Raises:
        ValueError: `limit` is out of its range.
    """
    if not 0 < limit <= 1:
        msg = f"limit {limit} is not within (0, 1]"
        raise ValueError(msg)
    servers = list(servers)
    used, chosen = _sum(servers), list[Demand]()
    most = Fraction(limit) * (1 + Fraction(1, 10**12))
    for task in by_period(tasks):
        chosen.append(task)
        used += task.share
        if used > most or not edf_schedulable(chosen, servers):
            chosen.pop()
            break
    return tuple(task.name for task in chosen)


def set_aside(
    tasks: Iterable[Demand],
    critical: Collection[str],
    servers: Iterable[Server] = (),
    *,
    limit: float = 1.0,
) -> tuple[str, ...] | None:
    """Return tasks that a lower criticality keeps out of the way of critical ones.

    At one criticality the earliest deadline goes first, so any tasks that EDF schedules
    may be in the critical set, whatever their rates: the critical ones, and with them
    as many of the others, shortest periods first, as fit (section 6.2.3). A period
    transformation leads to the same set, and asks the module to divide its work.

    Args:
        tasks: All periodic tasks of one RTPU.
        critical: The names of those that must not miss.
        servers: Servers with criticality 6.
        limit: As for `critical_set`.

    Returns:
        The tasks to set aside, longest periods last; None when the critical tasks alone
        ask for too much.
    """
    tasks, servers = by_period(tasks), list(servers)
    must = [task for task in tasks if task.name in critical]
    others = [task for task in tasks if task.name not in critical]
    most = Fraction(limit) * (1 + Fraction(1, 10**12))
    for kept in range(len(others), -1, -1):
        chosen = [*must, *others[:kept]]
        used = sum((task.share for task in chosen), _sum(servers))
        if used <= most and edf_schedulable(chosen, servers):
            return tuple(task.name for task in others[kept:])
    return None


# -- period transformation ------------------------------------------------------------


class Transformation(Struct, frozen=True, kw_only=True):
    """A task that is to run more often and do less each time (6.2.3, step 2)."""

    name: str
    factor: int
    """The old period by the new one."""
    period_ns: int
    cost_ns: int
    """The most that a cycle may then take."""


def transform(
    tasks: Iterable[Demand],
    critical: Collection[str],
    servers: Iterable[Server] = (),
    *,
    limit: float = 1.0,
) -> list[Transformation] | None:
    """Propose period transformations that bring critical tasks into the critical set.

    The critical set is filled by rate, so a slow task is the first to fall out of it.
    Dividing its period and its work by one factor leaves its utilization and moves it
    ahead. As many of the other tasks as can be stay in the set, and the factors are
    the smallest that achieve that.

    Args:
        tasks: All periodic tasks of one RTPU.
        critical: The names of those that must not miss.
        servers: Servers with criticality 6.
        limit: As for `critical_set`.

    Returns:
        What to change, empty when nothing needs to; None when the critical tasks alone
        ask for too much.

    Raises:
        ValueError: `limit` is out of its range.
    """
    tasks, servers = by_period(tasks), list(servers)
    must = {task.name for task in tasks} & set(critical)
    others = [task for task in tasks if task.name not in must]
    for kept in range(len(others), -1, -1):
        ahead_of = others[kept] if kept < len(others) else None
        changes = [
            change
            for task in tasks
            if task.name in must and (change := _ahead(task, ahead_of))
        ]
        if must <= set(critical_set(_apply(tasks, changes), servers, limit=limit)):
            return changes
    return None


def _ahead(task: Demand, other: Demand | None) -> Transformation | None:
    """Return what puts `task` ahead of `other`; None when it is there."""
    if other is None or (task.period_ns, task.name) < (other.period_ns, other.name):
        return None
    factor = task.period_ns // other.period_ns
    while (task.period_ns // factor, task.name) >= (other.period_ns, other.name):
        factor += 1
    return Transformation(
        name=task.name,
        factor=factor,
        period_ns=task.period_ns // factor,
        cost_ns=-(-task.cost_ns // factor),
    )


def _apply(tasks: list[Demand], changes: list[Transformation]) -> list[Demand]:
    new = {change.name: change for change in changes}
    return [
        structs.replace(
            task,
            period_ns=new[task.name].period_ns,
            cost_ns=new[task.name].cost_ns,
            deadline_ns=0,
        )
        if task.name in new
        else task
        for task in tasks
    ]


def largest_server(
    server: Server, tasks: Iterable[Demand], *, rm: bool = False, limit: float = 1.0
) -> int:
    """Return the greatest capacity with which all tasks still keep their deadlines.

    Args:
        server: Gives kind and period; its capacity is not used.
        tasks: The tasks below it: the critical set of MUF, or all tasks under RM.
        rm: RM schedules the tasks, not EDF.
        limit: Share of the core that tasks and server may use together.

    Returns:
        Nanoseconds a period, whole microseconds; 0 when there is no room.
    """
    tasks = list(tasks)
    test = rm_schedulable if rm else edf_schedulable
    room = max(0.0, limit - utilization(tasks))
    low, high = 0, int(min(1.0, room) * server.period_ns * (1 + 1e-12)) // STEP
    while low < high:
        middle = (low + high + 1) // 2
        if test(tasks, [structs.replace(server, capacity_ns=middle * STEP)]):
            low = middle
        else:
            high = middle - 1
    return low * STEP
