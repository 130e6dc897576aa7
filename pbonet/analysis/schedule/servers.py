"""Aperiodic servers: how large they may be, and what they take from the others.

A server has a capacity, CPU time that it may use at the highest criticality, and a
period in which that is given back. Four kinds are analysed in sections 6.5.1 and 6.5.2
of Stewart 1994: deferrable and sporadic ones, above tasks that RM or MUF schedules. The
four share one formula. With n periodic tasks of utilization U_p, let

    K = (1 + U_p / n) ** n        e ** U_p in the limit of many tasks, 1 + U_p for one;

then a deferrable server may have the size (2 - K) / (2K - 1), a sporadic one 2 / K - 1.
Under MUF the critical set counts as one task, because EDF schedules it.

Sizes and utilizations are shares of a core. `docs/decisions/0090` says where the
equation of the deferrable server promises too much, and `safe_size` what is right.
"""

from __future__ import annotations

import math
from enum import StrEnum

from msgspec import Struct


class ServerKind(StrEnum):
    """How the capacity of a server comes back."""

    DEFERRABLE = "deferrable"
    """Whole at the begin of every period; kept while no event waits (6.5.2.1)."""
    SPORADIC = "sporadic"
    """Each piece one period after its use began (6.5.2.2)."""
    POLLING = "polling"
    """Whole at the begin of every period, lost when no event waits for it."""
    BACKGROUND = "background"
    """There is none: whatever the others leave."""


class Server(Struct, frozen=True, kw_only=True):
    """A server in the form the schedulability tests use."""

    name: str = ""
    kind: ServerKind
    capacity_ns: int
    """CPU time that it may use at its criticality in a period."""
    period_ns: int

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: The capacity is not within 0 and the period.
        """
        if not 0 <= self.capacity_ns <= self.period_ns or self.period_ns <= 0:
            msg = (
                f"server {self.name}: capacity {self.capacity_ns} ns is not within 0 "
                f"and the period, {self.period_ns} ns"
            )
            raise ValueError(msg)

    @property
    def size(self) -> float:
        """The share of the core that is reserved: capacity by period."""
        return self.capacity_ns / self.period_ns

    def taken_ns(self, window_ns: int) -> int:
        """Return the most CPU time that the server uses in any window of that length.

        A deferrable server may end one period with its whole capacity and begin the
        next with it; a sporadic or polling one takes no more than a periodic task.

        Args:
            window_ns: Nanoseconds, not below 0.
        """
        capacity, first = self.capacity_ns, 0
        if self.kind is ServerKind.DEFERRABLE:
            first = min(window_ns, capacity)
            window_ns -= first
        whole, rest = divmod(window_ns, self.period_ns)
        return first + whole * capacity + min(rest, capacity)

    def delays_ns(self, window_ns: int) -> int:
        """Return `taken_ns`, with the piece that the window cuts counted whole.

        Work that is done in the window ends in none of the server's pieces, so both
        lead to the same response time; this one changes in steps and is iterated on.
        """
        shift = 0
        if self.kind is ServerKind.DEFERRABLE:
            shift = self.period_ns - self.capacity_ns
        return -(-(window_ns + shift) // self.period_ns) * self.capacity_ns

    @property
    def excess_ns(self) -> float:
        """The most by which `taken_ns` is above size times window, in nanoseconds."""
        pieces = 2 if self.kind is ServerKind.DEFERRABLE else 1
        return pieces * self.capacity_ns * (1 - self.size)


def _k(periodic: float, tasks: float) -> float:
    """Return K, see above; `tasks` may be infinite."""
    if not 0 <= periodic <= 1:
        msg = f"utilization {periodic} is not within 0 and 1"
        raise ValueError(msg)
    if not tasks >= 1:
        msg = f"{tasks} periodic tasks have no bound"
        raise ValueError(msg)
    if math.isinf(tasks):
        return math.exp(periodic)
    return math.pow(1.0 + periodic / tasks, tasks)


def server_size(kind: ServerKind, periodic: float, *, tasks: float = math.inf) -> float:
    """Return the largest capacity of a server by the thesis's equations.

    Equations 12 (deferrable, RM), 15 (sporadic, RM), 22 (deferrable, MUF) and 25
    (sporadic, MUF) of Stewart 1994; and the inverses of 10 and 13 for a finite `tasks`.

    Args:
        kind: Deferrable or sporadic.
        periodic: Utilization U_p of the periodic tasks, 0 to 1.
        tasks: How many periodic tasks RM schedules, m - 1 in the thesis; `math.inf`
            for the limit, 1 for the critical set of MUF.

    Returns:
        A share of the core, 0 to 1; 0 where no server fits.

    Raises:
        ValueError: An argument is out of its range, or the kind has no equation.
    """
    k = _k(periodic, tasks)
    if kind is ServerKind.DEFERRABLE:
        return max(0.0, (2.0 - k) / (2.0 * k - 1.0))
    if kind is ServerKind.SPORADIC:
        return max(0.0, 2.0 / k - 1.0)
    msg = f"a {kind.value} server has no equation in section 6.5"
    raise ValueError(msg)


def periodic_bound(kind: ServerKind, size: float, *, tasks: float = math.inf) -> float:
    """Return the utilization that the periodic tasks may have beside a server.

    Equations 10 and 11 (deferrable, RM), 13 and 14 (sporadic, RM), 21 (deferrable, MUF)
    and 24 (sporadic, MUF) of Stewart 1994.

    Args:
        kind: Deferrable or sporadic.
        size: The server's share of the core, 0 to 1.
        tasks: As for `server_size`.

    Returns:
        U_p, a share of the core.

    Raises:
        ValueError: An argument is out of its range, or the kind has no equation.
    """
    if not 0 <= size <= 1:
        msg = f"server size {size} is not within 0 and 1"
        raise ValueError(msg)
    if not tasks >= 1:
        msg = f"{tasks} periodic tasks have no bound"
        raise ValueError(msg)
    if kind is ServerKind.DEFERRABLE:
        k = (size + 2.0) / (2.0 * size + 1.0)
    elif kind is ServerKind.SPORADIC:
        k = 2.0 / (size + 1.0)
    else:
        msg = f"a {kind.value} server has no equation in section 6.5"
        raise ValueError(msg)
    if math.isinf(tasks):
        return math.log(k)
    return tasks * (math.pow(k, 1.0 / tasks) - 1.0)


def schedulable_bound(
    kind: ServerKind, periodic: float, *, tasks: float = math.inf
) -> float:
    """Return W = U_p plus the largest server size, as a function of U_p (Figure 6.8).

    The closing sentences of sections 6.5.1.1 and 6.5.1.2, and equations 23 and 26.
    Above the utilization at which no server fits, U_p itself is no longer guaranteed
    under RM, and W is what it was there.

    Raises:
        ValueError: As for `server_size`.
    """
    most = periodic_bound(kind, 0.0, tasks=tasks)
    periodic = min(periodic, most)
    return periodic + server_size(kind, periodic, tasks=tasks)


def bound_for_size(kind: ServerKind, size: float, *, tasks: float = math.inf) -> float:
    """Return W = U_p plus server size, as a function of the size (Figure 6.9).

    Equations 23 and 26 under MUF.

    Raises:
        ValueError: As for `periodic_bound`.
    """
    return periodic_bound(kind, size, tasks=tasks) + size


def safe_size(kind: ServerKind, periodic: float) -> float:
    """Return the largest size of a server above a critical set that EDF schedules.

    For the sporadic server equation 25. For the deferrable one equation 22 where the
    set uses half the core or more; below that a task with almost the server's period
    sees two whole capacities in one period, so that the size is (1 - U_p) / 2.

    Args:
        kind: Deferrable or sporadic.
        periodic: Utilization U_p of the critical set, 0 to 1; none of its periods is
            shorter than the server's.

    Raises:
        ValueError: As for `server_size`.
    """
    size = server_size(kind, periodic, tasks=1)
    if kind is ServerKind.DEFERRABLE:
        size = min(size, (1.0 - periodic) / 2.0)
    return size


def safe_bound(kind: ServerKind, size: float) -> float:
    """Return the utilization of a critical set beside a server: inverse of `safe_size`.

    Raises:
        ValueError: As for `periodic_bound`.
    """
    bound = periodic_bound(kind, size, tasks=1)
    if kind is ServerKind.DEFERRABLE:
        bound = max(0.0, min(bound, 1.0 - 2.0 * size))
    return bound
