"""Sees that those that came have done a cycle before others are killed for them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import TaskType
from pbonet.errors import PbonetError, StateError
from pbonet.master.configuration import stuck
from pbonet.pbo import State

if TYPE_CHECKING:
    import threading
    from collections.abc import Sequence

    from pbonet.master.configuration import Clock
    from pbonet.xm.net import messages as m

    from .subsystem_tasks import SubsystemTasks

    Item = tuple[str, str]

PATIENCE = 2.0
"""Seconds that are waited for first cycles at most; slower tasks are not waited for."""
_LOOK = 0.002


def prove(
    task_set: SubsystemTasks,
    items: Sequence[Item],
    kills: Sequence[Item],
    clock: Clock,
    stopped: threading.Event,
) -> dict[str, str]:
    """Wait for the first cycles of tasks that have come; return where these stand.

    Args:
        task_set: The subsystem's tasks.
        items: What was carried out.
        kills: What is to be done after it.
        clock: By which first cycles are waited for.
        stopped: Ends the wait when it is set.

    Raises:
        ReconfigError: One of them has failed, or an RTPU does not say how its tasks
            stand; no task was killed.
    """
    came = [task for task, signal in items if signal == "on"]
    end = clock.now() + PATIENCE
    while True:
        try:
            statuses = [task for rtpu in task_set.refresh() for task in rtpu.tasks]
        except PbonetError as silence:
            raise stuck([*items, *kills], len(items), silence) from silence
        there = {one.task: one for one in statuses if one.task in came}
        for one in there.values():
            if one.state in {State.ERROR, State.NOT_CREATED} and not stopped.is_set():
                error = _failed(one)
                raise stuck([*items, *kills], len(items), error) from error
        begins = [one for one in there.values() if _begins(task_set, one)]
        if not begins or clock.now() >= end or clock.wait(_LOOK, stopped):
            return {task: one.state for task, one in there.items()}


def _begins(task_set: SubsystemTasks, task: m.TaskStatus) -> bool:
    """Return whether a task has its first cycle, which time brings soon, before it."""
    member = task_set.model.get(task.task)
    periodic = member is not None and member.rmod.tasktype is TaskType.PERIODIC
    soon = task.ref_f * PATIENCE >= 1.0
    return periodic and soon and task.state == State.ON and not task.cycle


def _failed(task: m.TaskStatus) -> StateError:
    """Return the error for a task that has come and does not stay."""
    return StateError(
        f"{task.task}, which has come on, has failed",
        where=f"{task.rtpu}/{task.task}",
        expected="a first cycle before others are killed for it",
        got=task.error or f"state {task.state}",
        remedy="no task was killed: 'switch' back turns them on again",
    )
