"""Result of a simulated schedule: slices, misses, response times, as text and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
from msgspec import Struct

from .histogram import bin_of, edge_ns

if TYPE_CHECKING:
    from collections.abc import Sequence


class Segment(Struct, frozen=True, array_like=True):
    """An interval in which one task ran at one criticality."""

    task: str
    start_ns: int
    end_ns: int
    crit: int


class Distribution(Struct, frozen=True, kw_only=True):
    """Response times, nanoseconds."""

    count: int
    min_ns: int
    mean_ns: float
    p50_ns: int
    p90_ns: int
    p99_ns: int
    max_ns: int
    bins: list[tuple[float, int]]
    """Lower edge and count, of the bins that hold something; as the runtime's."""


def distribution(times_ns: Sequence[int]) -> Distribution | None:
    """Return how times are distributed, None when there are none."""
    if not times_ns:
        return None
    ordered = sorted(times_ns)
    counts: dict[int, int] = {}
    for time in ordered:
        index = bin_of(time)
        counts[index] = counts.get(index, 0) + 1
    return Distribution(
        count=len(ordered),
        min_ns=ordered[0],
        mean_ns=sum(ordered) / len(ordered),
        p50_ns=_quantile(ordered, 50),
        p90_ns=_quantile(ordered, 90),
        p99_ns=_quantile(ordered, 99),
        max_ns=ordered[-1],
        bins=[(edge_ns(index), count) for index, count in counts.items()],
    )


def _quantile(ordered: Sequence[int], percent: int) -> int:
    """Return the least time that `percent` of them do not exceed."""
    return ordered[max(0, -(-len(ordered) * percent // 100) - 1)]


class Account(Struct, kw_only=True):
    """The result for one task."""

    name: str
    crit: int
    period_ns: int
    """0 for a server that is not refilled."""
    deadline_ns: int
    """Relative; 0 for a server."""
    server: bool = False
    releases: int = 0
    """Of a server: events that arrived."""
    cycles: int = 0
    """Cycles, or events, run to their end."""
    missed: int = 0
    """Releases without a cycle of their own."""
    late: int = 0
    """Cycles that ended after their deadline."""
    given_up: int = 0
    """Missed ones that were not started, because MINC could no longer be granted."""
    overruns: int = 0
    """How often the reserve was used up: E, or the capacity."""
    cpu_ns: int = 0
    first_miss_ns: int = -1
    """When a deadline first passed unmet; -1 when none did."""
    misses_ns: list[int] = []
    """When releases found the last cycle unfinished."""
    releases_ns: list[int] = []
    responses_ns: list[int] = []
    """From release, or arrival, to end; one per cycle in order of their ends."""

    @property
    def misses(self) -> bool:
        """Whether any deadline passed unmet."""
        return bool(self.missed or self.late)


class Outcome(Struct, frozen=True, kw_only=True):
    """A simulated schedule."""

    start_ns: int
    end_ns: int
    segments: list[Segment]
    """In order of time; empty when they were not asked for."""
    tasks: dict[str, Account]

    @property
    def missing(self) -> set[str]:
        """The names of the tasks that missed a deadline."""
        return {name for name, account in self.tasks.items() if account.misses}

    @property
    def utilization(self) -> float:
        """The share of the core that was used."""
        span = self.end_ns - self.start_ns
        used = sum(account.cpu_ns for account in self.tasks.values())
        return used / span if span else 0.0

    def responses(self, name: str) -> Distribution | None:
        """Return how the response times of one task are distributed."""
        return distribution(self.tasks[name].responses_ns)

    def as_data(self, *, segments: bool = True) -> dict[str, object]:
        """Return everything as plain values, ready for JSON."""
        return {
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "utilization": self.utilization,
            "missing": sorted(self.missing),
            "tasks": {
                name: _account_data(account) for name, account in self.tasks.items()
            },
            "segments": msgspec.to_builtins(self.segments) if segments else [],
        }

    def as_text(self) -> str:
        """Return a table: a line for each task, times in milliseconds."""
        rows: list[tuple[str, ...]] = [_HEAD]
        span = max(self.end_ns - self.start_ns, 1)
        rows += [_row(account, span) for account in self.tasks.values()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join(
            "  ".join(
                cell.ljust(width) if place == 0 else cell.rjust(width)
                for place, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in rows
        )


_HEAD = (
    *("task", "crit", "releases", "cycles", "missed", "late", "CPU %"),
    *("min", "p50", "p99", "max ms"),
)


def _account_data(account: Account) -> dict[str, object]:
    spread = distribution(account.responses_ns)
    return {
        "crit": account.crit,
        "period_ns": account.period_ns,
        "server": account.server,
        "releases": account.releases,
        "cycles": account.cycles,
        "missed": account.missed,
        "late": account.late,
        "given_up": account.given_up,
        "overruns": account.overruns,
        "cpu_ns": account.cpu_ns,
        "first_miss_ns": account.first_miss_ns,
        "misses_ns": list(account.misses_ns),
        "responses": msgspec.to_builtins(spread),
    }


def _row(account: Account, span: int) -> tuple[str, ...]:
    spread = distribution(account.responses_ns)
    times = ["-"] * 4
    if spread is not None:
        picked = (spread.min_ns, spread.p50_ns, spread.p99_ns, spread.max_ns)
        times = [f"{time / 1e6:.3f}" for time in picked]
    return (
        account.name,
        str(account.crit),
        str(account.releases),
        str(account.cycles),
        "-" if account.server else str(account.missed),
        "-" if account.server else str(account.late),
        f"{100 * account.cpu_ns / span:.1f}",
        *times,
    )
