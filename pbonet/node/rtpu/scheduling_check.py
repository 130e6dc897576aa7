"""Finds tasks whose policy, priority or core another program has changed.

The dispatcher sets a level only when it changes, so a `chrt` or `taskset` from outside
would stay. Checked twice a second, by two system calls per task.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from pbonet.analysis.schedule import Mode
from pbonet.errors import Severity

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.analysis.schedule import SlotStatus
    from pbonet.node.rt import CoreTable
    from pbonet.node.wire import EventLog

    from .task_handle import Task

_NAMES = {
    os.SCHED_OTHER: "SCHED_OTHER",
    os.SCHED_FIFO: "SCHED_FIFO",
    os.SCHED_RR: "SCHED_RR",
    os.SCHED_BATCH: "SCHED_BATCH",
    os.SCHED_IDLE: "SCHED_IDLE",
}


class SchedulingCheck:
    """Compares what the kernel has with what the dispatcher has set.

    Args:
        core: The core table; its core is the tasks' only one.
        events: Takes the reports.
    """

    def __init__(self, core: CoreTable, events: EventLog) -> None:
        self._core = core
        self._events = events
        self._odd: set[tuple[str, str, int]] = set()
        """Tasks that had another level at the last check; it may have been changing."""

    def check(self, tasks: Iterable[tuple[Task, SlotStatus]]) -> None:
        """Report what was changed from outside, and put it right."""
        before, self._odd = self._odd, set()
        fifo = self._core.status().backend == "fifo"
        for task, slot in tasks:
            if task.ready is None:
                continue  # it is still to go to its core
            try:
                self._check_core(task, slot.pid)
                got = _scheduling(slot.pid) if fifo else ""
            except ProcessLookupError:
                continue
            key = (task.facts.subsystem, task.name, slot.pid)
            expected = _expected(slot)
            if not (got and expected) or got == expected:
                continue
            if expected != _expected(self._core.snapshot(task.facts.slot)):
                continue
            if key not in before:
                self._odd.add(key)
                continue
            self._core.relevel()
            self._report(task, f"its main thread is scheduled by {got}", expected)

    def _check_core(self, task: Task, pid: int) -> None:
        got, expected = os.sched_getaffinity(pid), {self._core.core}
        if got != expected:
            os.sched_setaffinity(pid, expected)
            cores = " ".join(map(str, sorted(got)))
            self._report(task, f"it may run on cores {cores}", f"{self._core.core}")

    def _report(self, task: Task, what: str, expected: str) -> None:
        self._events.add(
            Severity.WARNING,
            "SCHEDULING_CHANGED",
            f"{what} (expected {expected}): the task's module, or another program such "
            "as chrt or taskset, has changed that (the kernel does not tell which). It "
            "is put right",
            subsystem=task.facts.subsystem,
            task=task.name,
        )


def _expected(slot: SlotStatus) -> str:
    """Return the scheduling of a task that is ON; empty where it is not known."""
    if slot.mode is not Mode.ON:
        return ""
    if slot.hung:
        return f"{_NAMES[os.SCHED_OTHER]} 0"
    return f"{_NAMES[os.SCHED_FIFO]} {slot.level}" if slot.level else ""


def _scheduling(pid: int) -> str:
    """Return policy and priority of a process's main thread."""
    policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
    name = _NAMES.get(policy, f"policy {policy}")
    return f"{name} {os.sched_getparam(pid).sched_priority}"
