"""Report the analysis of each RTPU in full, as text and as data.

It says which deadlines are met and why: utilization, the critical set, what MUF, EDF
and RM would each guarantee, how large the servers may be, and where every execution
time comes from (Stewart 1994, chapter 6).
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING

import msgspec
from msgspec import Struct

from pbonet.analysis.schedule import (
    CoreShare,
    Demand,
    Server,
    ServerKind,
    Transformation,
    analysis,
    effective_time,
    server_size,
    transfers,
)
from pbonet.config import Scheduler, TaskType

from .demands import (
    Figure,
    Source,
    demands,
    effective,
    going_first,
    is_server,
    least,
    reserve,
    servers,
    worst,
)
from .records import Code, Configuration, Problem, Severity, Task
from .timing import (
    Load,
    check_loads,
    criticalities,
    load_without_servers,
    loads,
)
from .traffic import bytes_per_second, read_sizes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.analysis.schedule import Assigned
    from pbonet.config import RtpuEntry


class Outlook(StrEnum):
    """The verdict on an RTPU."""

    IDLE = "idle"
    """Nothing is ON there."""
    SCHEDULABLE = "schedulable"
    """Every deadline is met."""
    PARTLY = "critical set only"
    """Only tasks that are not CRITICAL may miss deadlines; they are named."""
    UNKEPT = "no deadline guaranteed"
    """Any task may miss deadlines; none of them is CRITICAL."""
    OVERLOADED = "overloaded"
    """Refused."""
    ASSUMED = "assumed"
    """Every deadline is met if tasks of unknown MAXC take no time."""


class TaskReport(Struct, frozen=True, kw_only=True):
    """One task, as far as scheduling is concerned; times in seconds."""

    task: str
    type: TaskType
    hz: float | None
    minc: Figure
    maxc: Figure
    effective: Figure | None
    """E, of a soft task."""
    utilization: float
    """Of what is reserved: C, E, or the capacity."""
    crit: int
    critical_set: bool
    guaranteed: bool
    """No deadline is missed; for a soft task: in no cycle that takes at most E."""
    response: float | None = None
    """Longest time from release to end, where fixed criticalities bound it."""
    every: int | None = None
    """Of a soft task: one of so many cycles is executed at least (C <= n * E)."""
    on_time: float | None = None
    """Of a soft task with a profile: share of the periods kept, at worst."""
    traffic: float
    """Bytes a second between the table and its local table (equation 6)."""


class ServerReport(Struct, frozen=True, kw_only=True):
    """One server, and how large it might be; times in seconds."""

    task: str
    kind: ServerKind
    period: float
    capacity: float
    size: float
    equation: int
    """Number of the thesis's equation that `by_equation` is read from."""
    by_equation: float
    """The largest size that the equation allows beside these periodic tasks."""
    largest: float
    """The largest capacity with which every task meets its deadlines, all periods
    known; of this server alone."""
    fits: bool
    """No task may miss for the servers of the RTPU that would not without them."""


class RtpuReport(Struct, frozen=True, kw_only=True):
    """One RTPU."""

    rtpu: str
    scheduler: Scheduler
    outlook: Outlook
    utilization: float
    """Equation 8, servers included."""
    bound: float
    core: CoreShare
    """The share of its core for its tasks, and where that comes from."""
    critical_set: tuple[str, ...]
    outside: tuple[str, ...]
    guaranteed: tuple[str, ...]
    unknown: tuple[str, ...]
    by_scheduler: dict[str, bool]
    """Whether every deadline would be met under MUF, EDF, RM (exact test) and
    ``RM bound`` (equation 9)."""
    transformations: tuple[Transformation, ...]
    """That would bring every CRITICAL task into the critical set."""
    tasks: tuple[TaskReport, ...]
    servers: tuple[ServerReport, ...]
    traffic: float
    """Bytes a second of all its tasks (equation 7)."""
    copy_speed: float
    """Bytes a second that the tasks of all RTPUs of its machine may move together."""
    copy_measured: bool
    """Whether its agent has measured that; else it is assumed."""
    write_wait: float
    """Seconds that a task waits to write into the table: equation 27, no lock."""
    read_wait: float
    """Seconds that repeated copies add at most to the longest read."""


def report(configuration: Configuration) -> list[RtpuReport]:
    """Return what the analysis finds about each RTPU, for the tasks that are ON."""
    moved = bytes_per_second(configuration)
    refused = {
        rtpu
        for problem in check_loads(configuration)
        if problem.severity is Severity.REFUSE
        for rtpu in _rtpus(configuration, problem)
    }
    return [
        _rtpu(configuration, rtpu, load, moved, refused)
        for rtpu, load in zip(configuration.rtpus, loads(configuration), strict=True)
    ]


def _rtpus(configuration: Configuration, problem: Problem) -> set[str]:
    """Return the RTPUs that a problem of the load is about."""
    if problem.code is Code.OVERLOAD:
        return {problem.where}
    return {t.rtpu for t in configuration.running if t.name in problem.tasks}


def _rtpu(
    configuration: Configuration,
    rtpu: RtpuEntry,
    load: Load,
    moved: dict[str, float],
    refused: set[str],
) -> RtpuReport:
    tasks = [task for task in configuration.running if task.rtpu == rtpu.name]
    asked, reserved = demands(tasks), servers(tasks)
    core, speed = configuration.share_of(rtpu.name), configuration.copies(rtpu.name)
    first = going_first(tasks, core)
    assigned = criticalities(tasks, rtpu, core=core)
    critical = {task.name for task in tasks if task.rmod.critical}
    changes: list[Transformation] | None = None
    if rtpu.scheduler is Scheduler.MUF and not critical <= set(load.critical_set):
        changes = analysis.transform(asked, critical, first, limit=core.share)
    responses = analysis.level_response_times(
        asked, {name: given.crit for name, given in assigned.items()}, first
    )
    return RtpuReport(
        rtpu=rtpu.name,
        scheduler=rtpu.scheduler,
        outlook=_outlook(load, rtpu.name in refused, tasks),
        utilization=load.utilization,
        bound=load.bound,
        core=core,
        critical_set=load.critical_set,
        outside=load.outside,
        guaranteed=load.guaranteed,
        unknown=load.unknown,
        by_scheduler=_by_scheduler(asked, first, core.share, serves=bool(reserved)),
        transformations=tuple(changes or ()),
        tasks=tuple(
            _task(task, assigned[task.name], load, moved[task.name], responses)
            for task in tasks
        ),
        servers=tuple(_servers(rtpu.scheduler, load, asked, reserved, configuration)),
        traffic=sum(moved[task.name] for task in tasks),
        copy_speed=speed,
        copy_measured=rtpu.name in configuration.copy_speeds,
        write_wait=transfers.write_wait(),
        read_wait=transfers.read_wait(
            max(read_sizes(configuration, tasks), default=0) / speed,
            transfers.RETRIES,
        ),
    )


def _outlook(load: Load, refused: bool, tasks: Sequence[Task]) -> Outlook:  # noqa: FBT001
    if refused:
        return Outlook.OVERLOADED
    if not tasks:
        return Outlook.IDLE
    if set(load.guaranteed) != {*load.critical_set, *load.outside}:
        return Outlook.PARTLY if load.guaranteed else Outlook.UNKEPT
    return Outlook.ASSUMED if load.unknown else Outlook.SCHEDULABLE


def _by_scheduler(
    asked: list[Demand], first: list[Server], limit: float, *, serves: bool
) -> dict[str, bool]:
    """Return what each algorithm would promise these tasks.

    Args:
        asked: What they ask for.
        first: What goes before them.
        limit: Share of the core for all that.
        serves: There are servers, of which equation 9 knows nothing.
    """
    every = {task.name for task in asked}
    used = analysis.utilization([*asked, *first])
    fits = used <= limit * (1 + 1e-9)
    rm = fits and analysis.rm_schedulable(asked, first)
    return {
        "MUF": set(analysis.critical_set(asked, first, limit=limit)) == every,
        "EDF": fits and analysis.edf_schedulable(asked, first),
        "RM": rm,
        "RM bound": rm and not serves and analysis.rm_bound_holds(asked),
    }


def _task(
    task: Task,
    assigned: Assigned,
    load: Load,
    moved: float,
    responses: dict[str, int | None],
) -> TaskReport:
    soft_time = effective(task)
    response = responses.get(task.name)
    known = not load.unknown and response is not None
    used = (reserve(task) or 0.0) * (task.hz or 0.0)
    return TaskReport(
        task=task.name,
        type=task.rmod.tasktype,
        hz=task.hz,
        minc=least(task),
        maxc=worst(task),
        effective=soft_time,
        utilization=assigned.utilization if is_server(task) else used,
        crit=assigned.crit,
        critical_set=task.name in load.critical_set,
        guaranteed=task.name in load.guaranteed,
        response=response / 1e9 if known and response is not None else None,
        every=_every(task, soft_time),
        on_time=_on_time(task, soft_time),
        traffic=moved,
    )


def _every(task: Task, soft_time: Figure | None) -> int | None:
    if soft_time is None or not soft_time.seconds or task.worst is None:
        return None
    return effective_time.every(round(task.worst * 1e9), round(soft_time.seconds * 1e9))


def _on_time(task: Task, soft_time: Figure | None) -> float | None:
    if soft_time is None or not soft_time.seconds or task.profile is None:
        return None
    return task.profile.on_time_share(round(soft_time.seconds * 1e9))


EQUATIONS = {
    (Scheduler.RM, ServerKind.DEFERRABLE): 12,
    (Scheduler.RM, ServerKind.SPORADIC): 15,
    (Scheduler.MUF, ServerKind.DEFERRABLE): 22,
    (Scheduler.MUF, ServerKind.SPORADIC): 25,
}
"""By scheduler and kind: which equation gives the largest size."""


def _servers(
    scheduler: Scheduler,
    load: Load,
    asked: list[Demand],
    reserved: list[Server],
    configuration: Configuration,
) -> list[ServerReport]:
    if not reserved:
        return []
    alone = set(load_without_servers(configuration, load.rtpu).guaranteed)
    kept = [task for task in asked if task.name in alone]
    used = min(1.0, analysis.utilization(kept))
    rm = scheduler is Scheduler.RM
    rule = Scheduler.RM if rm else Scheduler.MUF
    limit = configuration.limit(load.rtpu)
    return [
        ServerReport(
            task=server.name,
            kind=server.kind,
            period=server.period_ns / 1e9,
            capacity=server.capacity_ns / 1e9,
            size=server.size,
            equation=EQUATIONS[rule, server.kind],
            by_equation=server_size(server.kind, used, tasks=math.inf if rm else 1),
            largest=analysis.largest_server(server, asked, rm=rm, limit=limit) / 1e9,
            fits=alone <= set(load.guaranteed),
        )
        for server in reserved
    ]


# -- renderings -----------------------------------------------------------------------


def report_data(reports: Sequence[RtpuReport]) -> list[dict[str, object]]:
    """Return reports as plain values, ready for JSON."""
    found: list[dict[str, object]] = msgspec.to_builtins(list(reports))
    return found


def report_text(reports: Sequence[RtpuReport]) -> str:
    """Return reports as text, a paragraph and a table for each RTPU."""
    return "\n\n".join("\n".join(_lines(one)) for one in reports)


def report_head(one: RtpuReport) -> str:
    """Return the first line of an RTPU's report."""
    least_used = "at least " if one.unknown else ""
    found = one.outlook.value
    if one.outlook is Outlook.ASSUMED:
        found = "schedulable if unknown MAXC is 0"
    return (
        f"RTPU {one.rtpu} ({one.scheduler.value}): {found}, utilization "
        f"{least_used}{one.utilization:.1%} of {one.bound:.1%}"
    )


def _lines(one: RtpuReport) -> list[str]:
    if not one.tasks:
        return [report_head(one)]
    lines = [
        report_head(one),
        _core(one),
        f"  critical set: {' '.join(one.critical_set) or 'none'}",
    ]
    if late := [task.task for task in one.tasks if _may_miss(task)]:
        lines.append(f"  may miss deadlines: {' '.join(late)}")
    kept = [name for name, holds in one.by_scheduler.items() if holds]
    lines.append(f"  all deadlines would be met under: {', '.join(kept) or 'none'}")
    lines += [
        f"  period transformation: {c.name} at {c.factor} times its frequency, "
        f"{c.cost_ns / 1e6:.6g} ms a cycle"
        for c in one.transformations
    ]
    lines += [
        f"  server {s.task}: {s.kind.value}, {s.capacity * 1e3:g} ms every "
        f"{s.period * 1e3:g} ms ({s.size:.1%}); equation {s.equation} allows "
        f"{s.by_equation:.1%}, all periods known {s.largest * 1e3:g} ms; "
        f"{'fits' if s.fits else 'too large'}"
        for s in one.servers
    ]
    lines.append(
        f"  table: {one.traffic / 1e6:.6g} of {one.copy_speed / 1e6:.6g} MB/s "
        f"({'measured' if one.copy_measured else 'assumed'}); a write waits "
        f"{one.write_wait:g} s, a read {one.read_wait * 1e6:.3g} us at most"
    )
    return [*lines, *_table(one)]


def _core(one: RtpuReport) -> str:
    """Return the line about what the core grants."""
    rate = sum(task.hz or 0.0 for task in one.tasks)
    dispatching = one.core.dispatch * rate
    return (
        f"  core: {one.core.share:.1%} for tasks"
        + (f", {dispatching:.2%} of it for dispatching" if dispatching else "")
        + f" ({one.core.reason})"
    )


def _is_periodic(task: TaskReport) -> bool:
    return task.type in {TaskType.PERIODIC, TaskType.SYNCHRONOUS}


def _may_miss(task: TaskReport) -> bool:
    return _is_periodic(task) and not task.guaranteed


def _table(one: RtpuReport) -> list[str]:
    rows = [("task", "Hz", "MINC ms", "MAXC ms", "E ms", "U %", "crit", "set", "meets")]
    rows += [
        (
            task.task,
            "-" if task.hz is None else f"{task.hz:g}",
            _figure(task.minc) if _is_periodic(task) else "-",
            _figure(task.maxc) if _is_periodic(task) else "-",
            "-" if task.effective is None else _figure(task.effective),
            f"{100 * task.utilization:.1f}",
            str(task.crit),
            "yes" if task.critical_set else "no",
            _keeps(task) + (" if MAXC is 0" if task.guaranteed and one.unknown else ""),
        )
        for task in one.tasks
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  "
        + "  ".join(
            cell.ljust(width) for cell, width in zip(row, widths, strict=True)
        ).rstrip()
        for row in rows
    ]


def _figure(figure: Figure) -> str:
    """Return milliseconds and the source, such as ``1.2 measured``."""
    if figure.seconds is None:
        return "? assumed 0"
    source = "" if figure.source is Source.RMOD else f" {figure.source.value}"
    return f"{figure.seconds * 1e3:.6g}{source or ' .rmod'}"


def _keeps(task: TaskReport) -> str:
    if not task.guaranteed:
        return "-"
    if task.every is None:
        return "every deadline"
    share = "" if task.on_time is None else f", {task.on_time:.1%} of periods at worst"
    return f"1 of {task.every} cycles{share}"
