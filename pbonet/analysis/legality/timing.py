"""Can every RTPU keep its deadlines? (equations 8 and 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from msgspec import Struct, structs

from pbonet.analysis.schedule import (
    Assigned,
    CoreShare,
    Timing,
    critical_set,
    criticality,
    edf_schedulable,
    largest_server,
    level_guaranteed,
    set_aside,
    transform,
)
from pbonet.config import RtpuEntry, Scheduler

from .demands import demands, going_first, is_periodic, is_server, reserve, servers
from .records import Code, Configuration, Problem, Severity, Task

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pbonet.analysis.schedule import Server

SERVER = 6
"""Criticality of a server with capacity left (section 6.5.2.1)."""
BACKGROUND = 1
"""Criticality of a task that is not real-time (section 6.5.2)."""
MAX_FAULT = 1e-9


class Load(Struct, frozen=True, kw_only=True):
    """The demand of the tasks that are ON on one RTPU."""

    rtpu: str
    scheduler: Scheduler
    utilization: float
    """Equation 8, over the tasks whose MAXC is known, with E for soft ones."""
    bound: float
    """Up to which all deadlines are kept: equation 9 under RM, else the limit."""
    unknown: tuple[str, ...]
    """Tasks without MAXC; with any of them `utilization` is a lower bound."""
    critical_set: tuple[str, ...]
    outside: tuple[str, ...]
    """Tasks that may miss deadlines in an overload, shortest period first."""
    guaranteed: tuple[str, ...]
    """Tasks of which a test proves that they keep every deadline: the critical set of
    MUF, all or none under EDF, response times under RM beside equation 9."""


def criticalities(
    tasks: Sequence[Task], rtpu: RtpuEntry, *, core: CoreShare | None = None
) -> dict[str, Assigned]:
    """Return the criticality of each task that runs on one RTPU (6.2.3, 4.5.1).

    It rests on what RMODs declare, and on E of soft tasks; what else was measured does
    not count before it is adopted (decision 0096), here as on the RTPU itself.

    Under MUF the critical set is what EDF schedules below the servers, whose demand
    may come at the worst moment (section 6.5.2).

    Args:
        tasks: The tasks on that RTPU.
        rtpu: Says which scheduler it has, and its range of frequencies.
        core: What they may use of the core; None: all of it.

    Returns:
        By name; `assumed` where it rests on a MAXC that is not known.
    """
    tasks = [_as_declared(task) for task in tasks]
    periodic = [timing for task in tasks if (timing := _timing(task))]
    if rtpu.scheduler is Scheduler.EDF:
        found = criticality.edf(periodic)
    elif rtpu.scheduler is Scheduler.RM:
        found = criticality.rate_monotonic(periodic, rtpu.minfreq, rtpu.maxfreq)
    else:
        found = _muf(tasks, periodic, core or CoreShare())
    for task in tasks:
        if task.name not in found:
            found[task.name] = _aperiodic(task, rtpu)
    return {task.name: found[task.name] for task in tasks}


def _as_declared(task: Task) -> Task:
    """Return a task without measured times; of a soft one its profile stays, for E."""
    profile = task.profile if task.rmod.softness else None
    return structs.replace(task, minc=None, maxc=None, profile=profile)


def _muf(
    tasks: Sequence[Task], periodic: list[Timing], core: CoreShare
) -> dict[str, Assigned]:
    """Return MUF's rule with the critical set that is left beside the servers."""
    first, limit = going_first(tasks, core), core.left(t.hz or 0.0 for t in tasks)
    inside = set(critical_set(demands(tasks), first, limit=core.share))
    fixed = {timing.name for timing in periodic if timing.crit is not None}
    return {
        name: structs.replace(
            assigned,
            in_set=name in inside,
            crit=assigned.crit
            if name in fixed
            else criticality.INSIDE
            if name in inside
            else criticality.OUTSIDE,
        )
        for name, assigned in criticality.muf(periodic, limit).items()
    }


def _timing(task: Task) -> Timing | None:
    """Return what the rules need of a periodic task, None for another one."""
    if task.hz is None or is_server(task):
        return None
    return Timing(
        name=task.name, period=1.0 / task.hz, maxc=reserve(task), crit=task.rmod.crit
    )


def _aperiodic(task: Task, rtpu: RtpuEntry) -> Assigned:
    """Return the criticality of a server or of a background task."""
    if not is_server(task):
        rule = BACKGROUND
    elif rtpu.scheduler is Scheduler.RM:
        rule = criticality.RM_LEVELS
    else:
        rule = SERVER if rtpu.scheduler is Scheduler.MUF else criticality.INSIDE
    crit = rule if task.rmod.crit is None else task.rmod.crit
    used = (task.rmod.capacity or 0.0) * (task.hz or 0.0)
    return Assigned(crit=crit, assumed=False, in_set=False, utilization=used)


def loads(configuration: Configuration) -> list[Load]:
    """Return the load on each RTPU of the subsystem."""
    known = configuration.notes
    if "loads" not in known:
        known["loads"] = [_load(configuration, rtpu) for rtpu in configuration.rtpus]
    return cast("list[Load]", known["loads"])


def load_without_servers(configuration: Configuration, rtpu: str) -> Load:
    """Return the load on an RTPU without its servers."""
    here = [task for task in configuration.running if task.rtpu == rtpu]
    others = configuration.on - {server.name for server in servers(here)}
    entry = next(one for one in configuration.rtpus if one.name == rtpu)
    return _load(structs.replace(configuration, on=others), entry)


def _load(configuration: Configuration, rtpu: RtpuEntry) -> Load:
    tasks = [task for task in configuration.running if task.rtpu == rtpu.name]
    limit, core = configuration.limit(rtpu.name), configuration.share_of(rtpu.name)
    assigned = criticalities(tasks, rtpu, core=core)
    periodic = {task.name: task for task in tasks if is_periodic(task)}
    used = sum((reserve(t) or 0.0) * (t.hz or 0.0) for t in periodic.values())
    used += sum(assigned[t.name].utilization for t in tasks if is_server(t))
    bound = limit
    if rtpu.scheduler is Scheduler.RM and periodic:
        bound = min(bound, criticality.liu_layland(len(periodic)))
    inside = {name for name in periodic if assigned[name].in_set}
    if rtpu.scheduler is Scheduler.EDF and used <= bound * (1 + MAX_FAULT):
        inside = set(periodic)
    proven = _guaranteed(tasks, rtpu, assigned, inside, core)
    order = sorted(periodic, key=lambda name: (-(periodic[name].hz or 0.0), name))
    return Load(
        rtpu=rtpu.name,
        scheduler=rtpu.scheduler,
        utilization=used,
        bound=bound,
        unknown=tuple(name for name in order if periodic[name].worst is None),
        critical_set=tuple(name for name in order if name in inside),
        outside=tuple(name for name in order if name not in inside),
        guaranteed=tuple(name for name in order if name in proven),
    )


def _guaranteed(
    tasks: Sequence[Task],
    rtpu: RtpuEntry,
    assigned: dict[str, Assigned],
    inside: set[str],
    core: CoreShare,
) -> set[str]:
    """Return the periodic tasks that are proven to keep their deadlines."""
    asked, first = demands(tasks), going_first(tasks, core)
    limit = core.left(task.hz or 0.0 for task in tasks)
    levels = {name: given.crit for name, given in assigned.items()}
    by_rule = rtpu.scheduler is not Scheduler.RM and _by_rule(tasks, levels, inside)
    if not by_rule:
        proven = level_guaranteed(asked, levels, first)
        return {name for name in proven if _room(name, tasks, levels, limit)}
    if rtpu.scheduler is Scheduler.EDF and not edf_schedulable(asked, first):
        return set()
    return inside


def _by_rule(tasks: Sequence[Task], levels: dict[str, int], inside: set[str]) -> bool:
    """Return whether the set has one criticality and all others a lower one.

    A CRIT in an RMOD may make it otherwise, and measured times may be more than what
    the set was made for; then each level has to be examined.
    """
    if any(t.measured is not None for t in tasks):
        return False
    if not any(t.rmod.crit is not None for t in tasks if is_periodic(t)):
        return True
    lowest = min((levels[name] for name in inside), default=0)
    return (
        all(
            levels[task.name] < lowest
            for task in tasks
            if is_periodic(task) and task.name not in inside
        )
        and len({levels[name] for name in inside}) <= 1
    )


def _room(
    name: str, tasks: Sequence[Task], levels: dict[str, int], limit: float
) -> bool:
    """Return whether a task, those level with it and those above are within `limit`."""
    used = 0.0
    for task in tasks:
        if is_server(task):
            used += (task.rmod.capacity or 0.0) * (task.hz or 0.0)
        elif levels[task.name] >= levels[name]:
            used += (reserve(task) or 0.0) * (task.hz or 0.0)
    return used <= limit * (1 + MAX_FAULT)


def check_loads(configuration: Configuration) -> Iterator[Problem]:
    """Yield RTPUs that cannot keep their tasks' deadlines, as far as MAXC is known.

    A refusal rests on what files declare. What follows from measured times only is a
    warning, until they are adopted (decision 0096).
    """
    declared = _declared(configuration)
    refused = {
        (problem.code, problem.where)
        for problem in (_load_problems(declared) if declared else ())
        if problem.severity is Severity.REFUSE
    }
    for problem in _load_problems(configuration):
        firm = declared is None or (problem.code, problem.where) in refused
        if firm or problem.severity is Severity.WARN:
            yield problem
        else:
            yield structs.replace(
                problem,
                severity=Severity.WARN,
                got=f"{problem.got} with measured times",
            )


def _declared(configuration: Configuration) -> Configuration | None:
    """Return the configuration without measured times; None where none count."""
    if not any(task.measured is not None for task in configuration.running):
        return None
    tasks = tuple(map(_as_declared, configuration.tasks))
    return structs.replace(configuration, tasks=tasks)


def _load_problems(configuration: Configuration) -> Iterator[Problem]:
    tasks = {task.name: task for task in configuration.running}
    for load in loads(configuration):
        yield from _overload(load, tasks, configuration)
    for rtpu in configuration.rtpus:
        if rtpu.scheduler is Scheduler.RM:
            for task in configuration.running:
                if task.rtpu == rtpu.name:
                    yield from _rate(task, rtpu)


def _overload(
    load: Load, tasks: dict[str, Task], configuration: Configuration
) -> Iterator[Problem]:
    limit = configuration.limit(load.rtpu)
    over = load.utilization > limit * (1 + MAX_FAULT)
    # soft tasks may miss, but under EDF and RM an overload may take all their cycles
    spared = load.scheduler is Scheduler.MUF or not over
    late = [
        name
        for name in (*load.critical_set, *load.outside)
        if name not in load.guaranteed
        and not (load.unknown and load.scheduler is Scheduler.RM)
        and not (spared and tasks[name].rmod.softness)
    ]
    critical = [name for name in late if tasks[name].rmod.critical]
    if (late or over) and (found := _too_large(load, tasks, configuration, late)):
        yield found
    elif critical:
        yield _not_critical(load, configuration, critical, _raised(load, tasks, late))
    elif over and not _known_victims(load, late):
        yield _too_much(load, limit)
    elif late:
        strict = over and configuration.strict and load.scheduler is not Scheduler.MUF
        yield _may_miss(load, late, _raised(load, tasks, late), strict=strict)


def _may_miss(load: Load, late: list[str], hint: str, *, strict: bool) -> Problem:
    """Return who may miss deadlines; a refusal if that is not to happen at all."""
    any_of = "any of " * (load.scheduler is Scheduler.EDF and len(late) > 1)
    accept = ", or take STRICT out of the .sbs file" * strict
    return Problem(
        code=Code.NOT_GUARANTEED,
        severity=Severity.REFUSE if strict else Severity.WARN,
        what=f"on RTPU {load.rtpu} {any_of}{' and '.join(late)} may miss deadlines",
        where=load.rtpu,
        expected=_promise(load),
        got=_used(load),
        remedy=f"{hint}lower a frequency, or move a task to another RTPU{accept}",
        tasks=tuple(late),
    )


def _raised(load: Load, tasks: dict[str, Task], late: list[str]) -> str:
    """Return the remedy where a CRIT takes from the critical set what it needs."""
    names = [
        name
        for name in load.outside
        if (tasks[name].rmod.crit or 0) >= criticality.INSIDE
    ]
    harmed = load.scheduler is Scheduler.MUF and {*late} & {*load.critical_set}
    if not harmed or not names:
        return ""
    return f"take CRIT out of the RMOD of {' and '.join(names)}, "


def _known_victims(load: Load, late: list[str]) -> bool:
    """Return whether it is known who may miss in an overload.

    Under MUF it is those outside the critical set. Under RM it is those of low rate,
    and under EDF it may be anybody (section 6.2.2), if all execution times are known.
    """
    return load.scheduler is Scheduler.MUF or bool(late and not load.unknown)


def _promise(load: Load) -> str:
    if load.utilization > load.bound * (1 + MAX_FAULT):
        return f"a utilization of at most {load.bound:.1%} under {load.scheduler.value}"
    return (
        f"deadlines that hold under {load.scheduler.value} when servers use their "
        "whole capacity at the worst moment and each CRIT is as given"
    )


def _too_large(
    load: Load, tasks: dict[str, Task], configuration: Configuration, late: list[str]
) -> Problem | None:
    """Return the refusal of servers for which tasks would miss that else would not."""
    there = [t for t in configuration.running if t.rtpu == load.rtpu]
    reserved = servers(there)
    alone = load_without_servers(configuration, load.rtpu)
    limit = configuration.limit(load.rtpu)
    fits = alone.utilization <= limit * (1 + MAX_FAULT)
    every = {*alone.critical_set, *alone.outside}
    if not reserved or not fits or set(alone.guaranteed) != every:
        return None
    names = " and ".join(server.name for server in reserved)
    who = f"server {names} is" if len(reserved) == 1 else f"servers {names} are"
    victims = f": {' and '.join(late)} may miss deadlines" if late else ""
    return Problem(
        code=Code.SERVER,
        what=f"the {who} larger than RTPU {load.rtpu} can bear{victims}",
        where=tasks[reserved[0].name].place("CAPACITY"),
        expected=_largest(load, reserved, there, limit),
        got=" and ".join(f"{server.capacity_ns / 1e9:g} s" for server in reserved),
        remedy="lower CAPACITY, lower a frequency, or move a task to another RTPU",
        tasks=tuple(server.name for server in reserved),
    )


def _largest(
    load: Load, reserved: list[Server], there: list[Task], limit: float
) -> str:
    if len(reserved) > 1:
        return "servers that leave enough time for the tasks"
    asked = demands(there)
    most = largest_server(
        reserved[0], asked, rm=load.scheduler is Scheduler.RM, limit=limit
    )
    return f"at most {most / 1e9:.6g} s, once in {reserved[0].period_ns / 1e9:g} s"


def _not_critical(
    load: Load, configuration: Configuration, critical: list[str], hint: str
) -> Problem:
    """Return the refusal of CRITICAL tasks that the critical set does not hold."""
    names = " and ".join(critical)
    there = [t for t in configuration.running if t.rtpu == load.rtpu]
    limit, core = configuration.limit(load.rtpu), configuration.share_of(load.rtpu)
    first = going_first(there, core)
    remedy = f"lower the frequency of {names}"
    if load.scheduler is Scheduler.MUF:
        asked, must = demands(there), {t.name for t in there if t.rmod.critical}
        changes = transform(asked, must, first, limit=core.share) or ()
        aside = set_aside(asked, must, first, limit=core.share)
        ways = [
            _by_crit(load, there, aside),
            " and ".join(
                f"run {c.name} at {c.factor} times its frequency, with at most "
                f"{c.cost_ns / 1e9:.6g} s a cycle (period transformation)"
                for c in changes
            ),
        ]
        remedy = ", or ".join(filter(None, ways)) or remedy
    muf = "within the critical set, the shortest periods whose utilization is at most"
    return Problem(
        code=Code.OVERLOAD,
        what=f"RTPU {load.rtpu} is too busy for the CRITICAL {names}",
        where=load.rtpu,
        expected={
            Scheduler.MUF: f"CRITICAL tasks {muf} {limit:.1%}",
            Scheduler.EDF: f"a utilization of at most {limit:.1%} under EDF",
            Scheduler.RM: "CRITICAL tasks whose longest response is within their "
            "deadline",
        }[load.scheduler],
        got=_used(load),
        remedy=f"{hint}{remedy}, lower another task's frequency, or move one to "
        "another RTPU",
        tasks=tuple(critical),
    )


def _by_crit(load: Load, there: list[Task], aside: tuple[str, ...] | None) -> str:
    """Return the CRIT lines with which MUF guarantees critical tasks, if there are.

    The critical tasks must share one criticality, at which deadlines decide; none of
    the others may be above it, and those set aside must be below.
    """
    if aside is None:
        return ""
    together: list[str] = []
    below: list[str] = []
    for task in there:
        inside = criticality.INSIDE if task.name in load.critical_set else 0
        crit = inside if task.rmod.crit is None else task.rmod.crit
        if task.name in aside:
            below += [task.name] * (crit > criticality.OUTSIDE)
        elif is_server(task) or task.hz is None:
            continue
        elif crit > criticality.INSIDE or (
            task.rmod.critical and crit < criticality.INSIDE
        ):
            together.append(task.name)
    lines = [(together, criticality.INSIDE), (below, criticality.OUTSIDE)]
    given = [f"{' and '.join(names)} CRIT {crit}" for names, crit in lines if names]
    return "give " + ", and ".join(given) if given else ""


def _too_much(load: Load, limit: float) -> Problem:
    return Problem(
        code=Code.OVERLOAD,
        what=f"RTPU {load.rtpu} is overloaded",
        where=load.rtpu,
        expected=f"a utilization of at most {limit:.1%}",
        got=_used(load),
        remedy="lower a frequency, or move a task to another RTPU",
        tasks=load.outside,
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
