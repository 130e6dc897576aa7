"""A job as a problem of assignment: its tasks, and where each may run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.analysis import legality
from pbonet.analysis.allocation import FIXED, FOLLOWS, Item, Problem, declared
from pbonet.config import TaskType, element_type
from pbonet.errors import (
    PbonetError,
    SeveralError,
    UnknownTaskError,
    VerificationError,
    did_you_mean,
)
from pbonet.master.configuration import judged, planned_tasks

from . import known_rtpus

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from pbonet.config import JobFile
    from pbonet.master.configuration import Files

    from .known_rtpus import KnownRtpus

_BY_PLACE = frozenset({
    legality.Code.OVERLOAD,
    legality.Code.SERVER,
    legality.Code.NOT_GUARANTEED,
    legality.Code.FALLBACK_RTPU,
    legality.Code.NOT_ON_RTPU,
})
"""Faults of a job that another assignment may put right."""


def problem_of(
    files: Files,
    known: KnownRtpus,
    host: str,
    *,
    fixed: Collection[str] = (),
    assume: float | None = None,
    limit: float | None = None,
    weight: float = 0.5,
    latency: float = 0.0,
) -> tuple[Problem, list[str]]:
    """Return the problem of assigning a job's tasks, and warnings.

    Args:
        files: The job's files.
        known: What is known of the RTPUs.
        host: The machine whose saved profiles count where the RTPU's is not known.
        fixed: Tasks that stay where they are, beside those that the job marks.
        assume: Share of its period that a cycle takes whose MAXC is not known.
        limit: Share of a core that tasks may use; None: what the cores grant.
        weight: Share of the cost that traffic has.
        latency: Seconds that a value needs to another machine.

    Raises:
        ConfigError: A file is missing or wrong.
        VerificationError: The job is illegal, wherever its tasks run; or an execution
            time is not known.
        UnknownTaskError: A task that is to stay is not in the job.
    """
    job = files.read_job()
    hosts = {rtpu: known.hosts.get(rtpu) or host for rtpu in known.machines}
    by_host, warnings = _tasks_by_host(files, [host, *hosts.values()])
    tasks = by_host[host]
    _must_be_legal(files, tasks, known)
    _must_be_in(fixed, job)
    unknown = [t.name for t in tasks if _is_untimed(t)]
    if unknown and assume is None:
        raise _untimed(unknown, job.file)
    items = [
        _item(
            at,
            {r: by_host[hosts[r]][at] for r in known.machines},
            tasks,
            job,
            known,
            fixed=fixed,
            assume=assume,
        )
        for at in range(len(tasks))
    ]
    return Problem(
        items=tuple(items),
        rtpus=files.sbs.rtpus,
        machines=known.machines,
        keeper=files.sbs.keeper,
        sizes={
            one.name: one.nelem * kind.size
            for one in files.table.variables
            if (kind := element_type(one.type))
        },
        rates={one.name: one.rate for one in files.table.variables if one.rate},
        cores=known_rtpus.cores_of(known, limit),
        weight=weight,
        latency=latency,
    ), warnings


def _tasks_by_host(
    files: Files, hosts: Sequence[str]
) -> tuple[dict[str, list[legality.Task]], list[str]]:
    """Return the job's tasks with the times that were measured on each machine."""
    found: dict[str, list[legality.Task]] = {}
    warnings: list[str] = []
    for host in dict.fromkeys(hosts):
        found[host], parts = planned_tasks(files, host)
        errors = [PbonetError.from_wire(error) for error in parts.errors]
        if len(errors) > 1:
            raise SeveralError("the job cannot be allocated", errors)
        if errors:
            raise errors[0]
        warnings += [text for text in parts.warnings if text not in warnings]
    return found, warnings


def _must_be_legal(
    files: Files, tasks: Sequence[legality.Task], known: KnownRtpus
) -> None:
    """Check what no other assignment can put right.

    Raises:
        VerificationError: There is something.
    """
    verdict = judged(files, tasks, known.machines)
    assert verdict is not None  # noqa: S101 - every part could be read
    wrong = [one for one in verdict.refused if one.code not in _BY_PLACE]
    if wrong:
        raise legality.as_error(wrong)


def _must_be_in(fixed: Collection[str], job: JobFile) -> None:
    names = [n for line in job.tasks for n in (line.rmod, line.fallback) if n]
    for name in fixed:
        if name not in names:
            raise UnknownTaskError(
                f"the job has no task {name} that could stay where it is",
                where=job.file,
                got=f"tasks: {', '.join(names)}",
                remedy=did_you_mean(name, names) or "name one of them with --fix",
            )


def _is_untimed(task: legality.Task) -> bool:
    kind = task.rmod.tasktype
    return (
        kind is not TaskType.BACKGROUND
        and task.rmod.capacity is None
        and task.worst is None
        and (task.rmod.effc is None or not task.rmod.softness)
    )


def _untimed(names: Sequence[str], file: str) -> VerificationError:
    return VerificationError(
        "it is not known how long a cycle takes of " + ", ".join(names),
        where=file,
        expected="MAXC in the .rmod file, or a saved profile",
        remedy="measure it with 'pbonet run --profile' or 'pbonet profile --save', or "
        "give --assume SHARE",
    )


def _item(
    at: int,
    on: Mapping[str, legality.Task],
    tasks: Sequence[legality.Task],
    job: JobFile,
    known: KnownRtpus,
    *,
    fixed: Collection[str],
    assume: float | None,
) -> Item:
    """Return one of the job's tasks as an item.

    Args:
        at: Its place among `tasks`.
        on: The task by RTPU, with the times that count there.
        tasks: All of them.
        job: The job.
        known: What is known of the RTPUs.
        fixed: Tasks that stay where they are.
        assume: Share of its period that a cycle takes whose MAXC is not known.
    """
    task = tasks[at]
    pin, homes = _homes(task, job, known, fixed)
    original = _followed(task, tasks)
    for other in tasks:
        if other is original or _followed(other, tasks) is task:
            why, there = _homes(other, job, known, fixed)
            homes = [rtpu for rtpu in homes if rtpu in there] or [task.rtpu]
            pin = pin or (why and f"{other.name} {why}")
    if original is not None:
        pin = FOLLOWS + original.name
    return Item(
        name=task.name,
        present=task.rtpu,
        tasks={
            rtpu: structs.replace(declared(_timed(on[rtpu], assume)), rtpu=rtpu)
            for rtpu in homes
        },
        pin=pin,
        fallback_of=task.fallback_of,
        apart=bool(task.fallback_of and task.takeover),
    )


def _followed(
    task: legality.Task, tasks: Sequence[legality.Task]
) -> legality.Task | None:
    """Return the original on whose RTPU a standby always is; None if it has none."""
    if task.rmod.rtpu or task.takeover:
        return None
    return next((one for one in tasks if one.name == task.fallback_of), None)


def _timed(task: legality.Task, assume: float | None) -> legality.Task:
    if assume is None or not _is_untimed(task) or not task.hz:
        return task
    return structs.replace(task, maxc=assume / task.hz)


def _homes(
    task: legality.Task, job: JobFile, known: KnownRtpus, fixed: Collection[str]
) -> tuple[str, list[str]]:
    """Return why a task may not run everywhere, and the RTPUs where it may."""
    every = list(known.machines)
    marked = any(line.fixed for line in job.tasks if line.rmod == task.name)
    if marked or task.name in fixed:
        return f"{FIXED} in {'the job' if marked else '--fix'}", [task.rtpu]
    if things := legality.named_things(task.rmod, task.info):
        what = " and ".join(dict.fromkeys(f"{o.kind} {o.name}" for o in things))
        if not known.names:
            return f"opens {what}, and no agent was asked who has it", [task.rtpu]
        homes = [rtpu for rtpu in every if _has(known, rtpu, things)]
        return f"opens {what}", homes or [task.rtpu]
    if task.rmod.needs is not None:
        machine = known.machines.get(task.rtpu)
        there = [rtpu for rtpu in every if known.machines[rtpu] == machine]
        return f"NEEDS spp {task.rmod.needs.value}", there
    return "", every


def _has(known: KnownRtpus, rtpu: str, things: Sequence[legality.Named]) -> bool:
    """Return whether an RTPU has all these things; a kind it does not tell counts."""
    kinds = known.names.get(rtpu, {})
    return all(
        one.name in have for one in things if (have := kinds.get(one.kind)) is not None
    )
