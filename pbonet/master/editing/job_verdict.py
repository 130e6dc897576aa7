"""The verdict on a job that is edited, as `pbonet check` would give it."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from msgspec import Struct, structs

from pbonet.analysis import legality
from pbonet.errors import PbonetError
from pbonet.master.configuration import (
    Findings,
    Graph,
    GraphFault,
    here,
    judged,
    planned_graph,
    planned_tasks,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.config import JobTask

    from .draft_files import DraftFiles

NO_TASK = "the job has no task yet; add one from the library"


class JobVerdict(Struct, frozen=True, kw_only=True):
    """All that is known about one state of a job."""

    tasks: list[legality.Task]
    """The tasks whose RMODs and modules can be read."""
    verdict: legality.Verdict | None
    """None if a part is too faulty for one."""
    errors: list[str]
    """The errors of `pbonet check`, word for word."""
    warnings: list[str]
    graph: Graph
    first_problem: int
    """The place among the graph's faults of the verdict's first problem."""
    reports: list[legality.RtpuReport]

    @property
    def legal(self) -> bool:
        """Whether the job may be started."""
        return not self.errors

    @property
    def problems(self) -> tuple[legality.Problem, ...]:
        """The problems of the verdict."""
        return self.verdict.problems if self.verdict else ()

    @property
    def configuration(self) -> legality.Configuration | None:
        """The configuration in which the job would end."""
        return self.verdict.after if self.verdict else None

    def task(self, name: str) -> legality.Task | None:
        """Return a task; None: it has none of that name, or it cannot be read."""
        return next((one for one in self.tasks if one.name == name), None)

    def timing(self) -> list[dict[str, Any]]:
        """Return the load of each RTPU, for a bar."""
        return [_bar(one) for one in self.reports]


def judge_job(files: DraftFiles, host: str = "") -> JobVerdict:
    """Return the verdict on the job of a draft.

    Args:
        files: The files, with the draft's texts.
        host: The machine whose saved profiles are used; this one if empty.
    """
    tasks, found = planned_tasks(files, host or here())
    verdict = judged(files, tasks)
    errors, warnings = _errors_and_warnings(found, verdict)
    graph = planned_graph(files, tasks, found, verdict)
    graph = structs.replace(graph, faults=_with_tasks(files, graph.faults))
    if not files.draft.job.tasks:
        errors = [NO_TASK, *errors]
        fault = GraphFault(text=NO_TASK, severity="refuse", remedy="add a task")
        graph = structs.replace(graph, faults=[fault, *graph.faults])
    problems = len(verdict.problems) if verdict else 0
    return JobVerdict(
        tasks=tasks,
        verdict=verdict,
        errors=errors,
        warnings=warnings,
        graph=graph,
        first_problem=len(graph.faults) - problems,
        reports=legality.report(verdict.after) if verdict else [],
    )


def _with_tasks(files: DraftFiles, faults: list[GraphFault]) -> list[GraphFault]:
    """Return faults in which those of a file name the tasks that use it."""
    if all(fault.tasks for fault in faults):
        return faults
    places = [
        (place, name)
        for line in files.draft.job.tasks
        for name in (line.rmod, line.fallback)
        if name
        for place in _places(files, line, name)
    ]
    return [
        fault
        if fault.tasks
        else structs.replace(
            fault,
            tasks=list(dict.fromkeys(t for p, t in places if fault.text.startswith(p))),
        )
        for fault in faults
    ]


def _places(files: DraftFiles, line: JobTask, task: str) -> Iterator[str]:
    """Yield the beginnings of messages about a task: its line, and its files."""
    if line.place is not None:
        yield f"{line.place.file}:{line.place.line}:"
    with contextlib.suppress(PbonetError):
        yield f"{files.part(task, line.freq).file}:"
        known = files.library.files().get(files.rmod(task, line.freq).record.module)
        if known is not None:
            yield f"{known}:"


def _errors_and_warnings(
    found: Findings, verdict: legality.Verdict | None
) -> tuple[list[str], list[str]]:
    """Return errors and warnings in the order in which `pbonet check` has them."""
    errors = [str(PbonetError.from_wire(error)) for error in found.errors]
    warnings = [*found.warnings]
    if verdict is not None:
        errors += map(legality.as_text, verdict.refused)
        warnings += map(legality.as_text, verdict.warnings)
    return errors, warnings


def _bar(one: legality.RtpuReport) -> dict[str, Any]:
    """Return what a bar of an RTPU's load shows."""
    kept = set(one.guaranteed)
    every = (*one.critical_set, *one.outside)
    return {
        "rtpu": one.rtpu,
        "scheduler": one.scheduler.value,
        "utilization": one.utilization,
        "bound": one.bound,
        "outlook": one.outlook.value,
        "text": legality.report_head(one),
        "late": [name for name in every if name not in kept],
        "unknown": list(one.unknown),
        "tasks": [
            {
                "task": task.task,
                "utilization": task.utilization,
                "maxc": task.maxc.seconds,
                "source": task.maxc.source.value,
                "guaranteed": task.guaranteed,
            }
            for task in one.tasks
        ],
    }
