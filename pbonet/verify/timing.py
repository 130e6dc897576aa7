"""Can every RTPU keep its deadlines, and the table its traffic? (eq. 6 to 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.config.model import RtpuEntry, Scheduler, TaskType
from pbonet.config.types import element_type
from pbonet.sched import criticality
from pbonet.sched.criticality import Assigned, Timing

from .records import Code, Configuration, Problem, Severity, Task

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

SERVER = 6
"""Criticality of a server with capacity left (section 6.5.2.1)."""
BACKGROUND = 1
"""Criticality of a task that is not real-time (section 6.5.2)."""
MAX_FAULT = 1e-9


class Load(Struct, frozen=True, kw_only=True):
    """What the tasks that are ON ask of one RTPU."""

    rtpu: str
    scheduler: Scheduler
    utilization: float
    """Equation 8, over the tasks whose MAXC is known."""
    bound: float
    """Up to which all deadlines are kept: equation 9 under RM, else the limit."""
    unknown: tuple[str, ...]
    """Tasks without MAXC; with any of them `utilization` is a lower bound."""
    critical_set: tuple[str, ...]
    outside: tuple[str, ...]
    """Tasks that may miss deadlines in an overload, shortest period first."""


def criticalities(
    tasks: Sequence[Task], rtpu: RtpuEntry, *, limit: float = 1.0
) -> dict[str, Assigned]:
    """Return the criticality of each task that runs on one RTPU (6.2.3, 4.5.1).

    Args:
        tasks: The tasks on that RTPU.
        rtpu: Says which scheduler it has, and its range of frequencies.
        limit: Share of the core that the critical set of MUF may use.

    Returns:
        By name; `assumed` where it rests on a MAXC that is not known.
    """
    periodic = [timing for task in tasks if (timing := _timing(task))]
    servers = [task for task in tasks if _is_server(task)]
    if rtpu.scheduler is Scheduler.EDF:
        found = criticality.edf(periodic)
    elif rtpu.scheduler is Scheduler.RM:
        found = criticality.rate_monotonic(periodic, rtpu.minfreq, rtpu.maxfreq)
    else:
        reserved = sum((t.rmod.capacity or 0.0) * (t.hz or 0.0) for t in servers)
        found = criticality.muf(periodic, max(limit - reserved, MAX_FAULT))
    for task in tasks:
        if task.name not in found:
            found[task.name] = _aperiodic(task, rtpu)
    return {task.name: found[task.name] for task in tasks}


def _timing(task: Task) -> Timing | None:
    """Return what the rules need of a periodic task, None for another one."""
    if task.hz is None or _is_server(task):
        return None
    return Timing(
        name=task.name, period=1.0 / task.hz, maxc=task.worst, crit=task.rmod.crit
    )


def _is_server(task: Task) -> bool:
    return task.rmod.tasktype in {TaskType.SPORADIC, TaskType.DEFERRABLE}


def _aperiodic(task: Task, rtpu: RtpuEntry) -> Assigned:
    """Return the criticality of a server or of a background task."""
    if not _is_server(task):
        rule = BACKGROUND
    elif rtpu.scheduler is Scheduler.RM:
        rule = criticality.RM_LEVELS
    else:
        rule = SERVER if rtpu.scheduler is Scheduler.MUF else criticality.INSIDE
    crit = rule if task.rmod.crit is None else task.rmod.crit
    used = (task.rmod.capacity or 0.0) * (task.hz or 0.0)
    return Assigned(crit=crit, assumed=False, in_set=False, utilization=used)


def loads(configuration: Configuration) -> list[Load]:
    """Return what is asked of each RTPU of the subsystem."""
    return [_load(configuration, rtpu) for rtpu in configuration.rtpus]


def _load(configuration: Configuration, rtpu: RtpuEntry) -> Load:
    tasks = [task for task in configuration.running if task.rtpu == rtpu.name]
    assigned = criticalities(tasks, rtpu, limit=configuration.limit)
    periodic = {task.name: task for task in tasks if _timing(task)}
    used = sum((t.worst or 0.0) * (t.hz or 0.0) for t in periodic.values())
    used += sum(assigned[t.name].utilization for t in tasks if _is_server(t))
    bound = configuration.limit
    if rtpu.scheduler is Scheduler.RM and periodic:
        bound = min(bound, criticality.liu_layland(len(periodic)))
    inside = {name for name in periodic if assigned[name].in_set}
    if rtpu.scheduler is Scheduler.EDF and used <= bound * (1 + MAX_FAULT):
        inside = set(periodic)
    order = sorted(periodic, key=lambda name: (-(periodic[name].hz or 0.0), name))
    return Load(
        rtpu=rtpu.name,
        scheduler=rtpu.scheduler,
        utilization=used,
        bound=bound,
        unknown=tuple(name for name in order if periodic[name].worst is None),
        critical_set=tuple(name for name in order if name in inside),
        outside=tuple(name for name in order if name not in inside),
    )


def check_loads(configuration: Configuration) -> Iterator[Problem]:
    """Yield RTPUs that cannot keep their tasks' deadlines, as far as MAXC is known."""
    tasks = {task.name: task for task in configuration.running}
    for load in loads(configuration):
        yield from _overload(load, tasks, configuration.limit)
    for rtpu in configuration.rtpus:
        if rtpu.scheduler is Scheduler.RM:
            for task in configuration.running:
                if task.rtpu == rtpu.name:
                    yield from _rate(task, rtpu)


def _overload(load: Load, tasks: dict[str, Task], limit: float) -> Iterator[Problem]:
    late = [
        name
        for name in load.outside
        if not (load.unknown and load.scheduler is Scheduler.RM)
        and not tasks[name].rmod.softness
    ]
    critical = [name for name in late if tasks[name].rmod.critical]
    over = load.utilization > limit * (1 + MAX_FAULT)
    if over and (critical or load.scheduler is not Scheduler.MUF):
        yield _too_much(load, limit, critical or list(load.outside))
    elif late and load.utilization > load.bound * (1 + MAX_FAULT):
        yield Problem(
            code=Code.NOT_GUARANTEED,
            severity=Severity.WARN,
            what=f"on RTPU {load.rtpu} {' and '.join(late)} may miss deadlines",
            where=load.rtpu,
            expected=f"a utilization of at most {load.bound:.1%} under "
            f"{load.scheduler.value}",
            got=_used(load),
            remedy="lower a frequency, or move a task to another RTPU",
            tasks=tuple(late),
        )


def _too_much(load: Load, limit: float, tasks: list[str]) -> Problem:
    names = " and ".join(tasks)
    ends = load.scheduler is Scheduler.MUF
    return Problem(
        code=Code.OVERLOAD,
        what=f"RTPU {load.rtpu} is too busy for the CRITICAL {names}"
        if ends
        else f"RTPU {load.rtpu} is asked for more than it has",
        where=load.rtpu,
        expected="CRITICAL tasks within the critical set, the shortest periods whose "
        f"utilization is at most {limit:.1%}"
        if ends
        else f"a utilization of at most {limit:.1%}",
        got=_used(load),
        remedy=f"raise the frequency of {names} above that of others, lower another "
        "task's, or move one to another RTPU"
        if ends
        else "lower a frequency, or move a task to another RTPU",
        tasks=tuple(tasks),
    )


def _used(load: Load) -> str:
    least = "at least " if load.unknown else ""
    return f"{least}{load.utilization:.1%}"


def _rate(task: Task, rtpu: RtpuEntry) -> Iterator[Problem]:
    hz = task.hz
    if hz is None or rtpu.minfreq <= hz <= rtpu.maxfreq:
        return
    keyword = "MINFREQ" if hz < rtpu.minfreq else "MAXFREQ"
    yield Problem(
        code=Code.RATE,
        severity=Severity.WARN,
        what=f"task {task.name} runs at {hz:g} Hz, beyond {keyword} of RTPU "
        f"{rtpu.name}, and gets the criticality of that",
        where=task.name,
        expected=f"{rtpu.minfreq:g} to {rtpu.maxfreq:g} Hz",
        got=f"{hz:g} Hz",
        remedy=f"correct {keyword} in the .sbs file, or the task's frequency",
        tasks=(task.name,),
    )


def traffic(configuration: Configuration) -> dict[str, float]:
    """Return the bytes a second that each task that is ON moves (equation 6).

    The locking overhead of the equation is zero here, as the table has no lock. Tasks
    without a frequency count as nothing.
    """
    size = {
        variable.name: variable.nelem * kind.size
        for variable in configuration.svar.variables
        if (kind := element_type(variable.type))
    }
    return {
        task.name: (task.hz or 0.0)
        * sum(size.get(name, 0) for name in (*task.inputs, *task.outputs))
        for task in configuration.running
    }


def check_traffic(configuration: Configuration) -> Iterator[Problem]:
    """Yield a problem when all tasks together move more than the table can (eq. 7)."""
    moved = traffic(configuration)
    total = sum(moved.values())
    if total <= configuration.copy_speed:
        return
    most = max(moved, key=lambda name: (moved[name], name))
    yield Problem(
        code=Code.BANDWIDTH,
        what="the tasks move more data than the table is allowed to",
        where=most,
        expected=f"at most {configuration.copy_speed / 1e6:.6g} MB/s (equation 7)",
        got=f"{total / 1e6:.6g} MB/s, of which {most} {moved[most] / 1e6:.6g} MB/s",
        remedy=f"lower the frequency of {most}, or combine it with the tasks it talks "
        "to",
        tasks=(most,),
    )
