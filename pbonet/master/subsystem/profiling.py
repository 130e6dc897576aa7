"""Data of `profile`: every figure of section 6.7.1, for tasks and for RTPUs.

Stewart 1994, section 6.7.1, defines the figures; decision 0040 says where ours divide
by something else. They run since the task was turned on, the execution profile Psi(t)
since it was spawned.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pbonet.analysis.schedule import effective_time, histogram
from pbonet.errors import StateError
from pbonet.master.configuration import profile_of
from pbonet.xm.net import TaskProfile, messages as m

from . import status_fields

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from pbonet.config import Rmod
    from pbonet.master.configuration import Saved
    from pbonet.xm.net import RtpuStatus

    from .subsystem_tasks import SubsystemTasks

Data = dict[str, Any]
QUANTILES: Final = (0.5, 0.9, 0.99, 0.999)
OF_RTPU: Final[dict[str, Callable[[list[float]], float]]] = {
    **dict.fromkeys(("cycle", "miss", "failed", "mezF", "totC", "nowC"), sum),
    **dict.fromkeys(("minU", "avgU", "maxU"), sum),
    "minC": min,
    **dict.fromkeys(("maxC", "firstC", "ptime", "tick"), max),
}
"""How figures of tasks make a figure of their RTPU; means are made from these."""
FAILURES: Final = ("failures", "overruns", "aborted", "skipped", "delivery_max")
"""Timing failures in a status (section 6.3)."""


def ask(task_set: SubsystemTasks, tasks: Sequence[str]) -> list[TaskProfile]:
    """Return the profiles of tasks, of all if none is named, RTPU by RTPU.

    Raises:
        UnknownTaskError: There is no such task.
    """
    task_set.refresh(strict=False)
    for task in tasks:
        task_set.model.find(task)
    results, errors = task_set.clients.each(lambda _: m.Profile(), list[TaskProfile])
    task_set.warn(map(str, errors))
    found = [one for name in task_set.clients.names for one in results.get(name, [])]
    return [one for one in found if not tasks or one.status.task in tasks]


def save(task_set: SubsystemTasks, tasks: Sequence[str]) -> list[tuple[Saved, Path]]:
    """Save profiles beside the ``.sbs`` file, for later starts; return them.

    Where no task is named, those that have run too few cycles are reported as warnings.

    Raises:
        UnknownTaskError: There is no such task.
        StateError: One that was named has run too few cycles.
        ConfigFileError: A file cannot be written.
    """
    saved: list[tuple[Saved, Path]] = []
    for found in ask(task_set, tasks):
        rmod = task_set.model.find(found.status.task).rmod
        host = task_set.clients.agent(found.status.rtpu).host
        when = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        try:
            saved.append(
                task_set.files.profiles.keep(found, rmod, host=host, when=when)
            )
        except StateError as error:
            if tasks:
                raise
            task_set.warned(str(error))
    return saved


def task_data(found: TaskProfile, rmod: Rmod | None) -> Data:
    """Return everything that is known of one task's execution times; seconds.

    Args:
        found: Its profile.
        rmod: Its RMOD, for what is declared; None where it is not known.
    """
    fields = status_fields.profile(found.status).fields
    counts = _counts(found.cpu)
    psi = profile_of(tuple(found.cpu), found.most) if found.cpu else None
    softness = rmod.softness if rmod else None
    reserve = None
    if rmod is not None and softness:
        reserve = effective_time.effective(
            softness,
            given_ns=None if rmod.effc is None else round(rmod.effc * 1e9),
            profile=psi,
            worst_ns=None if rmod.maxc is None else round(rmod.maxc * 1e9),
        )
    return {
        "task": found.status.task,
        "rtpu": found.status.rtpu,
        "figures": fields,
        "counted": sum(counts),
        "least": found.least if psi else None,
        "most": found.most if psi else None,
        "quantiles": _quantiles(counts, found.most),
        "delays": _quantiles(_counts(found.jitter), found.status.jitter_max),
        "late": found.late,
        "failed": found.failed,
        **{name: getattr(found.status, name) for name in FAILURES},
        "sections": msgspec.to_builtins(found.status.sections),
        "declared": {
            key: getattr(rmod, key) if rmod else None
            for key in ("minc", "maxc", "effc", "softness")
        },
        "effective": reserve.time_ns / 1e9 if reserve and reserve.time_ns else None,
        "psi": [
            [time / 1e9, share]
            for time, share in zip(psi.times_ns, psi.shares, strict=True)
        ]
        if psi
        else [],
    }


def rtpu_data(status: RtpuStatus, tasks: Iterable[Data]) -> Data:
    """Return the figures of one RTPU: its own, and the sums over its tasks."""
    here = [task["figures"] for task in tasks if task["rtpu"] == status.rtpu]
    joined: Data = {
        name: join(values)
        if (values := [t[name] for t in here if t[name] is not None])
        else None
        for name, join in OF_RTPU.items()
    }
    cycles = joined["cycle"] or 0
    released = cycles + (joined["miss"] or 0) + (joined["failed"] or 0)
    return {
        "rtpu": status.rtpu,
        "backend": status.backend,
        "scheduler": status.scheduler,
        "util": status.util,
        "dispatcher": status.dispatcher,
        "tasks": len(here),
        **joined,
        "avgC": joined["totC"] / cycles if cycles else None,
        "mezT": joined["ptime"] / released if released else None,
    }


def _counts(bins: Sequence[tuple[int, int]]) -> list[int]:
    counts = [0] * histogram.BINS
    for index, count in bins:
        counts[index] = count
    return counts


def _quantiles(counts: Sequence[int], most: float) -> dict[str, float | None]:
    """Return quantiles; none is beyond the greatest value, which is known exactly."""
    known = any(counts)
    return {
        f"p{100 * share:g}": min(histogram.quantile_ns(counts, share) / 1e9, most)
        if known
        else None
        for share in QUANTILES
    }
