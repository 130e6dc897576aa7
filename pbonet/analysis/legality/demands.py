"""A task's demand of its core, for the schedulability tests.

A periodic task asks for its worst execution time in every period, a soft one for its
effective one (Stewart 1994, section 6.4), a server for its capacity. What an RMOD
declares goes before what was measured; what is not known counts as nothing, and is
said to be assumed.
"""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.schedule import Demand, Server, ServerKind, effective_time
from pbonet.config import TaskType

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pbonet.analysis.schedule import CoreShare

    from .records import Task

NS = 1e9
SERVER_TYPES = {
    TaskType.DEFERRABLE: ServerKind.DEFERRABLE,
    TaskType.SPORADIC: ServerKind.SPORADIC,
}


class Source(StrEnum):
    """Where an execution time comes from."""

    RMOD = "rmod"
    MEASURED = "measured"
    ASSUMED = "assumed"
    """Not given: 0 in place of MINC and MAXC, MAXC in place of E."""


class Figure(Struct, frozen=True):
    """An execution time and where it comes from."""

    seconds: float | None
    """None where it is not known and counts as 0."""
    source: Source


def is_server(task: Task) -> bool:
    """Return whether a task serves events with a capacity."""
    return task.rmod.tasktype in SERVER_TYPES


def is_periodic(task: Task) -> bool:
    """Return whether a task runs at a rate, whether the clock or a device gives it."""
    return task.hz is not None and not is_server(task)


def least(task: Task) -> Figure:
    """Return MINC: the RMOD's, else measured, else assumed."""
    if task.rmod.minc is not None:
        return Figure(task.rmod.minc, Source.RMOD)
    if task.minc is not None:
        return Figure(_at_most(task.minc, task.worst), Source.MEASURED)
    return Figure(None, Source.ASSUMED)


def _at_most(seconds: float, limit: float | None) -> float:
    return seconds if limit is None else min(seconds, limit)


def worst(task: Task) -> Figure:
    """Return MAXC: the RMOD's, else measured, else assumed."""
    if task.rmod.maxc is not None:
        return Figure(task.rmod.maxc, Source.RMOD)
    if task.worst is not None:
        return Figure(task.worst, Source.MEASURED)
    return Figure(None, Source.ASSUMED)


_SOURCES = {
    effective_time.Basis.GIVEN: Source.RMOD,
    effective_time.Basis.MEASURED: Source.MEASURED,
    effective_time.Basis.ASSUMED: Source.ASSUMED,
}


def effective(task: Task) -> Figure | None:
    """Return E of a soft task, None for a hard one (section 6.4).

    The RMOD's EFFC, else read from the execution profile, else MAXC stands for it.
    """
    if not task.rmod.softness:
        return None
    found = effective_time.effective(
        task.rmod.softness,
        given_ns=None if task.rmod.effc is None else ns(task.rmod.effc),
        profile=task.profile,
        worst_ns=None if task.worst is None else ns(task.worst),
    )
    seconds = None if found.time_ns is None else found.time_ns / NS
    return Figure(seconds, _SOURCES[found.basis])


def reserve(task: Task) -> float | None:
    """Return the CPU seconds reserved in each period: E or C, None if not known."""
    soft = effective(task)
    return task.worst if soft is None else soft.seconds


def ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * NS)


def demands(tasks: Iterable[Task]) -> list[Demand]:
    """Return what the periodic tasks among `tasks` ask for."""
    return [
        Demand(
            name=task.name,
            period_ns=ns(1.0 / task.hz),
            cost_ns=ns(reserve(task) or 0.0),
        )
        for task in tasks
        if task.hz is not None and not is_server(task)
    ]


def servers(tasks: Iterable[Task]) -> list[Server]:
    """Return the servers among `tasks` that have a capacity and a period."""
    return [
        Server(
            name=task.name,
            kind=SERVER_TYPES[task.rmod.tasktype],
            capacity_ns=min(ns(task.rmod.capacity), ns(1.0 / task.hz)),
            period_ns=ns(1.0 / task.hz),
        )
        for task in tasks
        if is_server(task) and task.rmod.capacity is not None and task.hz is not None
    ]


def going_first(tasks: Sequence[Task], core: CoreShare) -> list[Server]:
    """Return what goes before all periodic tasks: servers, and the dispatcher.

    The dispatcher takes its time at each release, of a task in the critical set or not,
    as a server of that period would.

    Args:
        tasks: All tasks of one RTPU.
        core: What dispatching takes of its core.
    """
    counts = Counter(ns(1.0 / task.hz) for task in tasks if task.hz)
    return servers(tasks) + [
        Server(
            name="dispatcher",
            kind=ServerKind.SPORADIC,
            capacity_ns=min(count * ns(core.dispatch), period),
            period_ns=period,
        )
        for period, count in counts.items()
        if core.dispatch
    ]
