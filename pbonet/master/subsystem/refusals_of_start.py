"""Reasons for which a job would be refused now, each by itself; nothing is changed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.analysis import legality
from pbonet.errors import PbonetError
from pbonet.master import configuration

from . import assembly
from .condition_gate import ConditionGate

if TYPE_CHECKING:
    from pathlib import Path

    from .subsystem_tasks import SubsystemTasks


def start_refusals(
    task_set: SubsystemTasks, job: str | Path | None
) -> list[configuration.GraphFault]:
    """Return the faults for which the start of a job would be refused now.

    These are faults of its files, of the configuration that would result, and
    conditions that do not hold. RTPUs that do not answer are left out.

    Args:
        task_set: The tasks of an open subsystem.
        job: The ``.job`` file or its name; None: the one it was opened with.
    """
    found: list[configuration.GraphFault] = []
    try:
        wanted = task_set.files.read_job(job)
        change = assembly.change(task_set, wanted)
        task_set.with_infos(task_set.reached)
        verdict = legality.judge(task_set.configuration(), change)
        found += map(configuration.fault, verdict.refused)
        if wanted.pre and task_set.files.sbs.keeper not in task_set.silent:
            ConditionGate(task_set, wanted, leaves=False).must_hold()
    except PbonetError as error:
        found.append(
            configuration.GraphFault(
                text=str(error), severity="refuse", remedy=error.remedy
            )
        )
    return found
