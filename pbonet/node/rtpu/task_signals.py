"""Signals of tasks in the RTPU process: counts, masks, what was not reported.

A task counts each signal in shared memory and sends a notice with it. Notices may be
dropped or held back in a flood; the counts never are. Signals that were counted and not
reported become one event per task and check, so that a flood of signals is no flood of
events.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct, field

from pbonet.node.wire import severity
from pbonet.pbo import PREDEFINED, SIGNALS, signal_bits, signal_names

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.node.rt import CoreTable
    from pbonet.node.wire import EventLog

    from .task_handle import Task


def by_name(counts: Iterable[int], own: dict[str, int]) -> dict[str, int]:
    """Return counts by the names of the signals; those without a name if not 0.

    Args:
        counts: One for each bit.
        own: Names and bits of the module's own signals.
    """
    known = sum((PREDEFINED | own).values())
    return {
        signal_names(1 << k, own)[0]: count
        for k, count in enumerate(counts)
        if count or known >> k & 1
    }


class _Reported(Struct):
    """How many of a task's signals became events, by bit."""

    counts: list[int] = field(default_factory=lambda: [0] * SIGNALS)
    behind: list[int] = field(default_factory=lambda: [0] * SIGNALS)
    """How many were unreported at the last check; notices may have been under way."""


class Signals:
    """The signals of all tasks of one RTPU.

    Args:
        events: Takes the reports.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._masks: dict[tuple[str, str], list[str]] = {}
        self._told: dict[Task, _Reported] = {}

    # -- masks -------------------------------------------------------------------------

    def masks(self, subsystem: str) -> dict[str, list[str]]:
        """Return the masks that are set, by task; ``""`` is the whole subsystem."""
        return {
            key[1]: names for key, names in self._masks.items() if key[0] == subsystem
        }

    def mask(self, subsystem: str, task: str, names: list[str] | None) -> None:
        """Set or, with None, unset a mask; an empty `task` means the subsystem."""
        if names is None:
            self._masks.pop((subsystem, task), None)
        else:
            self._masks[subsystem, task] = names

    def forget(self, subsystem: str) -> None:
        """Forget a subsystem's masks."""
        for task in self.masks(subsystem):
            self.mask(subsystem, task, None)

    def apply(self, core: CoreTable, task: Task) -> None:
        """Apply a task's mask; without one, that of its subsystem."""
        subsystem = task.facts.subsystem
        names = self._masks.get((subsystem, task.name))
        if names is None:
            names = self._masks.get((subsystem, ""), [])
        core.mask_signals(task.facts.slot, signal_bits(names, task.signals))

    # -- counts ------------------------------------------------------------------------

    def reported(self, task: Task, bits: int) -> None:
        """Note that signals have become an event."""
        reported = self._told.setdefault(task, _Reported())
        for k in range(SIGNALS):
            reported.counts[k] += bits >> k & 1

    def report_missing(self, core: CoreTable, tasks: Iterable[Task]) -> None:
        """Report what was counted and is still not reported at this check."""
        for task in tasks:
            reported = self._told.setdefault(task, _Reported())
            now = [
                count - known
                for count, known in zip(
                    core.signals(task.facts.slot), reported.counts, strict=True
                )
            ]
            self._report(task, reported, list(map(min, now, reported.behind)))
            reported.behind = now

    def end(self, core: CoreTable, task: Task) -> None:
        """Report what is left of a task that has ended, and forget it."""
        reported = self._told.pop(task, _Reported())
        counts = core.signals(task.facts.slot)
        rest = [
            count - known for count, known in zip(counts, reported.counts, strict=True)
        ]
        self._report(task, reported, rest)

    def _report(self, task: Task, reported: _Reported, missing: list[int]) -> None:
        bits = sum(1 << k for k, count in enumerate(missing) if count > 0)
        if not bits:
            return
        missing = [max(count, 0) for count in missing]
        reported.counts = list(map(sum, zip(reported.counts, missing, strict=True)))
        named = by_name(missing, task.signals).items()
        text = ", ".join(f"{count} {name}" for name, count in named if count)
        self._events.add(
            severity(bits),
            "SIGNALS",
            f"not reported individually: {text}",
            subsystem=task.facts.subsystem,
            task=task.name,
            bits=bits,
        )
