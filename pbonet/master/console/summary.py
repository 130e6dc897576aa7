"""Summary of a run: one line per task, from its last status and its recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from pbonet.master.subsystem import delay_quantile, profile
from pbonet.pbo import State

from . import render

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    from pbonet.log import Cycles
    from pbonet.xm.net import RtpuStatus, TaskStatus

HEAD = (
    *(
        "task",
        "rtpu",
        "last state",
        "cycles",
        "missed",
        "failed",
        "Hz",
        "CPU avg",
        "CPU max",
    ),
    *("CPU", "jitter p50", "p99", "max", "transfer", "warn"),
)
SINCE = "since each task was turned on last:"
_FAILED = (State.ERROR, State.NOT_CREATED)
"""States that have a reason, unless the task was killed by order."""


class Seen:
    """How each task was seen last, also those that were gone before the others."""

    def __init__(self) -> None:
        self._rtpus: dict[str, RtpuStatus] = {}
        self._tasks: dict[str, TaskStatus] = {}

    def update(self, rtpus: Iterable[RtpuStatus]) -> None:
        """Note the present state of the tasks, wherever each was before."""
        rtpus = list(rtpus)
        self._rtpus |= {rtpu.rtpu: rtpu for rtpu in rtpus}
        there = [task for rtpu in rtpus for task in rtpu.tasks]
        there.sort(key=lambda task: task.state != State.NOT_CREATED)
        self._tasks |= {task.task: task for task in there}  # those that live count

    def last(self, killed: Container[str] = ()) -> list[RtpuStatus]:
        """Return the last status of each RTPU, with the last one of each task there.

        Args:
            killed: Tasks that were killed by order: their failures are settled.
        """
        tasks = [
            msgspec.structs.replace(task, state=State.NOT_CREATED, error="")
            if task.task in killed
            else task
            for task in self._tasks.values()
        ]
        return [
            msgspec.structs.replace(
                rtpu, tasks=[task for task in tasks if task.rtpu == name]
            )
            for name, rtpu in self._rtpus.items()
        ]


class TaskSummary(Struct, frozen=True, kw_only=True):
    """One task's figures since it was turned on; times in seconds, None if unknown."""

    task: str
    rtpu: str
    state: str
    """In which the end found it, or in which it was seen last."""
    cycles: int
    missed: int
    failed: int
    """Cycles that ended in an error."""
    hz: float | None
    cpu_avg: float | None
    cpu_max: float | None
    utilization: float | None
    """CPU time of the mean cycle per period, in per cent."""
    jitter_p50: float | None
    jitter_p99: float | None
    jitter_max: float | None
    jitter_exact: bool
    """False: upper edges of histogram bins, powers of two in microseconds."""
    transfer: float | None
    """Share of the CPU time spent on transfers, in per cent (Table 1 of 6.6.1)."""
    warnings: int
    lost: int = 0
    """Cycles that were not recorded, because their ring was full."""
    error: str = ""


def summarize(rtpus: Iterable[RtpuStatus]) -> list[TaskSummary]:
    """Return a summary of each task; what takes no virtual time is None."""
    return [
        _task(task, virtual=rtpu.backend == "inline")
        for rtpu in rtpus
        for task in rtpu.tasks
    ]


def refined(summaries: Iterable[TaskSummary], cycles: Cycles) -> list[TaskSummary]:
    """Return summaries with exact delays, for tasks with all cycles recorded."""
    return [_refined(one, cycles) for one in summaries]


def _refined(one: TaskSummary, cycles: Cycles) -> TaskSummary:
    if one.task not in cycles.tasks:
        return one
    arrays = cycles.arrays(one.task)
    if not len(arrays["release_ns"]):
        return one
    import numpy as np  # at the end of a run, not before its first cycle

    delays = (arrays["start_ns"] - arrays["release_ns"]) * 1e-9
    return msgspec.structs.replace(
        one,
        jitter_p50=float(np.quantile(delays, 0.5)),
        jitter_p99=float(np.quantile(delays, 0.99)),
        jitter_max=float(delays.max()),
        jitter_exact=True,
    )


def _task(status: TaskStatus, *, virtual: bool) -> TaskSummary:
    fields: dict[str, Any] = profile(status).fields
    if virtual:
        fields |= dict.fromkeys(("avgC", "maxC", "avgU", "xfer"))
    quantiles = [delay_quantile(status.jitter, share) for share in (0.5, 0.99)]
    return TaskSummary(
        task=status.task,
        rtpu=status.rtpu,
        state=status.state,
        cycles=status.cycle,
        missed=status.miss,
        failed=status.failed,
        hz=fields["mezF"],
        cpu_avg=fields["avgC"],
        cpu_max=fields["maxC"],
        utilization=fields["avgU"],
        jitter_p50=quantiles[0],
        jitter_p99=quantiles[1],
        jitter_max=status.jitter_max if status.cycle and not virtual else None,
        jitter_exact=False,
        transfer=fields["xfer"],
        warnings=status.warn,
        lost=status.lost,
        error=status.error if status.state in _FAILED else "",
    )


def text(summaries: Iterable[TaskSummary]) -> str:
    """Return the summary as a table."""
    summaries = list(summaries)
    if not summaries:
        return "no tasks"
    lines = [SINCE, render.table(HEAD, [_row(one) for one in summaries])]
    lines += [f"ERROR> {one.task}: {one.error}" for one in summaries if one.error]
    return "\n".join(lines)


def _row(one: TaskSummary) -> list[str]:
    mark = "" if one.jitter_exact else "<"
    return [
        one.task,
        one.rtpu,
        one.state,
        str(one.cycles),
        str(one.missed),
        str(one.failed),
        "-" if one.hz is None else f"{one.hz:.1f}",
        render.seconds(one.cpu_avg),
        render.seconds(one.cpu_max),
        _percent(one.utilization),
        _marked(mark, one.jitter_p50),
        _marked(mark, one.jitter_p99),
        render.seconds(one.jitter_max),
        _percent(one.transfer),
        str(one.warnings),
    ]


def _marked(mark: str, value: float | None) -> str:
    return "-" if value is None else f"{mark}{render.seconds(value)}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}%"
