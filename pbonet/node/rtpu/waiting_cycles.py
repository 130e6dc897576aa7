"""Finds tasks whose cycles wait for something other than the core.

A sleep, a file, a lock or a slow device in `cycle` misses deadlines although the task
uses hardly any CPU time. What passes between the begin and the end of a cycle is CPU
time, time in which other tasks have the core, or waiting. The kernel counts the second
one, from being ready to running; so the rest is waiting. Checked twice a second.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.schedule import Kind, Mode
from pbonet.errors import Severity
from pbonet.node.wire import main_thread_times

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.analysis.schedule import SlotStatus
    from pbonet.node.wire import EventLog

    from .task_handle import Task

_SHARE = 0.2
"""Of the period, which a mean cycle must wait to be reported ..."""
_CHECKS = 2
"""... in so many checks one after the other."""
_CYCLES = 2
"""Cycles that a check covers at least."""
_LEAST_NS = 200_000
"""Nanoseconds; shorter waits are not reported."""


class _Reading(Struct, frozen=True):
    """Counters of one task; times in nanoseconds."""

    cycles: int
    missed: int
    wall: int
    cpu: int
    others: int
    """Time in which it was ready and others had the core."""


class _Watched(Struct):
    last: _Reading
    found: int = 0
    """Checks, one after the other, in which its cycles have waited."""


def ready_ns(pid: int) -> int | None:
    """Return how long a process's main thread was ready without having a core.

    None: the kernel does not count it, or the process is gone.
    """
    times = main_thread_times(pid)
    return None if times is None else times.ready


class WaitingCycles:
    """Compares the counters of tasks with those of the last check.

    Args:
        events: Takes the reports.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._tasks: dict[tuple[str, str, int], _Watched] = {}

    def check(self, tasks: Iterable[tuple[Task, SlotStatus]]) -> None:
        """Set `waits` of each task, and report cycles that have begun to wait."""
        before, self._tasks = self._tasks, {}
        for task, slot in tasks:
            others = ready_ns(slot.pid) if _counts(slot) else None
            if others is None:
                task.waits = ""
                continue
            key = (task.facts.subsystem, task.name, slot.pid)
            cycles, held = slot.cycles + slot.failed, others + slot.held_ns
            reading = _Reading(
                cycles, slot.missed, slot.wall_total_ns, slot.cpu_total_ns, held
            )
            watched = before.get(key) or _Watched(reading)
            self._tasks[key] = watched
            if cycles - watched.last.cycles >= _CYCLES:
                self._compare(task, slot, watched, reading)
                watched.last = reading

    def _compare(
        self, task: Task, slot: SlotStatus, watched: _Watched, now: _Reading
    ) -> None:
        last = watched.last
        cycles, wall = now.cycles - last.cycles, now.wall - last.wall
        waited = wall - (now.cpu - last.cpu) - (now.others - last.others)
        if waited < cycles * max(_SHARE * slot.period_ns, _LEAST_NS):
            watched.found, task.waits = 0, ""
            return
        watched.found += 1
        if watched.found != _CHECKS:
            return
        task.waits = (
            f"a cycle takes {_ms(wall, cycles)} ms, of which it computes for "
            f"{_ms(now.cpu - last.cpu, cycles)} ms and waits for {_ms(waited, cycles)}"
        )
        self._events.add(
            Severity.WARNING,
            "WAITS",
            f"{task.waits}; {now.missed - last.missed} of "
            f"{cycles + now.missed - last.missed} releases were missed. Only `sync` "
            f"may wait: see what cycle() of module {task.facts.rmod.module} waits for "
            "(a sleep, a file, a lock, a device)",
            subsystem=task.facts.subsystem,
            task=task.name,
            cycle=slot.cycles - slot.on_cycles,
        )


def _counts(slot: SlotStatus) -> bool:
    """Return whether the task is ON and has cycles that a clock or a device times."""
    timed = slot.kind in {Kind.PERIODIC, Kind.SYNCHRONOUS}
    return timed and slot.mode is not Mode.OFF


def _ms(ns: int, cycles: int) -> str:
    return f"{max(ns, 0) / cycles / 1e6:.3g}"
