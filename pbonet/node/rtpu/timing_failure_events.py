"""Reports timing failures, stalls and refused calls; checked twice a second.

The dispatcher and the tasks count them in shared memory without waiting for any other
process. Here the counts become events, one per task and check, so that a flood of
failures is no flood of events.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.analysis.schedule import Kind
from pbonet.errors import Severity
from pbonet.node.rt import KINDS
from pbonet.node.wire import CoreTimes

if TYPE_CHECKING:
    from collections.abc import Collection

    from pbonet.analysis.schedule import CoreStatus, SlotStatus
    from pbonet.node.wire import EventLog

    from .task_handle import Task

_THROTTLE = Path("/proc/sys/kernel/sched_rt_runtime_us")


class TimingFailureEvents:
    """Compares counts with those of the last check.

    Args:
        events: Takes the reports.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._failures: dict[tuple[str, str, int], tuple[int, ...]] = {}
        self._hung: set[tuple[str, str, int, int]] = set()
        """Cycles that do not return, by subsystem, task, process and number; -1 for
        events without end."""
        self._times: CoreTimes | None = None
        self._stalls = 0
        self._stalled_ns = 0
        self._errors = 0

    def begin(self, core: CoreStatus) -> None:
        """Read the times of the core from now on, as the first task has come."""
        if self._times is None:
            self._times = CoreTimes(core.core)
            self._times.read(core.leader_pid, core.leader_tid)

    def report_new(
        self, core: CoreStatus, tasks: Collection[tuple[Task, SlotStatus]]
    ) -> None:
        """Report what has come since the last check."""
        times = ""
        if not tasks:
            self._times = None  # reading them is most of what an idle RTPU does
        elif self._times is None:
            self.begin(core)
        else:
            times = self._times.read(core.leader_pid, core.leader_tid)
        seen: dict[tuple[str, str, int], tuple[int, ...]] = {}
        hung: set[tuple[str, str, int, int]] = set()
        for task, slot in tasks:
            key = (task.facts.subsystem, task.name, slot.pid)
            if slot.hung or slot.flooded:
                hung.add(cycle := (*key, -1 if slot.flooded else slot.cycles))
                if cycle not in self._hung:
                    self._report_hung(task, slot)
            seen[key] = (*slot.failures, slot.held_off)
            before = self._failures.get(key, (0,) * len(seen[key]))
            if seen[key] != before:
                self._report(task, slot, (before, seen[key]), times)
        self._failures, self._hung = seen, hung
        self._check_core(core)

    def _report_hung(self, task: Task, slot: SlotStatus) -> None:
        """Report a cycle, or a `sync`, that does not return, or events without end."""
        if slot.flooded:
            self._report_flood(task, slot)
            return
        what = "`sync`" if slot.in_sync else "a cycle"
        until = "an event comes" if slot.in_sync else "it does"
        remedy = "let it block" if slot.in_sync else "see what it waits for"
        self._events.add(
            Severity.ERROR,
            "HANGS",
            f"{what} of module {task.facts.rmod.module} has taken "
            f"{slot.cpu_now_ns / 1e9:.2f} s of CPU time and does not return; until "
            f"{until}, all other tasks go first; {remedy}, or kill {task.name}",
            subsystem=task.facts.subsystem,
            task=task.name,
            cycle=slot.cycles - slot.on_cycles,
        )

    def _report_flood(self, task: Task, slot: SlotStatus) -> None:
        """Report events without end, of a device or a server."""
        if slot.kind is Kind.SYNCHRONOUS:
            text = (
                "returns more than ten times as often as declared "
                f"({1e9 / slot.period_ns:g} Hz); until it does not, all other tasks go "
                "first; let it wait for an event"
            )
        else:
            text = (
                "returns so often that the capacity is used up in every period; beyond "
                "it all other tasks go first, until some is left; let it wait for an "
                "event, declare more"
            )
        self._events.add(
            Severity.ERROR,
            "HANGS",
            f"`sync` of module {task.facts.rmod.module} {text}, or kill {task.name}",
            subsystem=task.facts.subsystem,
            task=task.name,
            cycle=slot.cycles - slot.on_cycles,
        )

    def _report(
        self,
        task: Task,
        slot: SlotStatus,
        counts: tuple[tuple[int, ...], tuple[int, ...]],
        core: str,
    ) -> None:
        names = (*KINDS, "overlong critical section")
        news = [
            f"{now - then} {name}"
            for name, then, now in zip(names, *counts, strict=True)
            if now > then
        ]
        times = [f"timing failures: {', '.join(news)}"]
        if slot.cpu_now_ns > slot.cpu_max_ns:
            now = slot.cpu_now_ns / 1e6
            times.append(f"the cycle under way has taken {now:g} ms of CPU time so far")
            if not slot.maxc_ns:
                times.append("MAXC in its .rmod would bound what a cycle takes")
        if slot.cpu_max_ns:
            longest = slot.cpu_max_ns / 1e6
            times.append(f"the longest cycle took {longest:g} ms of CPU time")
        if slot.maxc_ns:
            times.append(f"reserve {slot.maxc_ns / 1e6:g} ms")
        if slot.safe:
            times.append(
                f"safe values were written {slot.safe} times since it was spawned, the "
                f"last {slot.safe_last_ns / 1e3:.1f} us after the failure"
            )
        if core:
            times.append(core)
        self._events.add(
            Severity.WARNING,
            "TIMING_FAILURE",
            "; ".join(times),
            subsystem=task.facts.subsystem,
            task=task.name,
            cycle=slot.cycles - slot.on_cycles,
        )

    def report_end(self, task: Task, slot: SlotStatus) -> None:
        """Report that a task has ended amid a cycle whose safe values stay.

        Nothing else says so: the cycle's own record was never written.
        """
        if slot.safe_stands:
            self._events.add(
                Severity.WARNING,
                "LEFT_SAFE",
                f"the task has ended amid a cycle that had failed in time; "
                f"{', '.join(task.facts.outputs)} got the safe values "
                f"{slot.safe_last_ns / 1e3:.1f} us after the failure, and keep them "
                "until another task writes",
                subsystem=task.facts.subsystem,
                task=task.name,
                cycle=slot.cycles - slot.on_cycles,
            )

    def _check_core(self, core: CoreStatus) -> None:
        if core.stalls > self._stalls:
            count = core.stalls - self._stalls
            took = (core.stalled_ns - self._stalled_ns) / 1e6
            self._events.add(
                Severity.WARNING,
                "CORE_STALLED",
                f"core {core.core} stood still "
                f"{'once' if count == 1 else f'{count} times'}, {took:.0f} ms in all; "
                f"{_cause()}",
            )
        if core.errors > self._errors:
            self._events.add(
                Severity.ERROR,
                "CALLS_REFUSED",
                f"the kernel refused {core.errors - self._errors} calls about tasks of "
                f"core {core.core}; their order may be wrong. Has somebody taken "
                "rights away? `pbonet doctor` says which there are",
            )
        self._stalls, self._stalled_ns = core.stalls, core.stalled_ns
        self._errors = core.errors


def _cause() -> str:
    """Return what may have stopped a core, as far as the kernel reports it."""
    try:
        runtime = int(_THROTTLE.read_text(encoding="ascii"))
    except (OSError, ValueError):
        runtime = -1
    if runtime < 0:
        return "its processes were stopped, or the machine was suspended"
    return (
        f"above {runtime / 10_000:g} % of a core the kernel throttles all real-time "
        "tasks (kernel.sched_rt_runtime_us); or its processes were stopped, or the "
        "machine was suspended"
    )
