"""Signals of tasks in the RTPU process: counts, masks, what was not reported.

A task counts each signal in shared memory and sends a notice with it. Notices may be
dropped or held back in a flood; the counts never are. Signals that were counted and not
reported become one event per task and check, so that a flood of signals is no flood of
events. Warnings that a task repeats are joined.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field

from pbonet.errors import Severity
from pbonet.node.wire import severity
from pbonet.pbo import PREDEFINED, SIGNALS, Signal, signal_bits, signal_names

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.node.rt import CoreTable
    from pbonet.node.wire import EventLog, rtpu_messages

    from .task_handle import Task

WINDOW_NS: Final = 10_000_000_000
"""Nanoseconds in which warnings of one cause become one event."""
SINGLE: Final = 3
"""Warnings of one cause that are reported one by one, before they are joined."""
_JOINED: Final = frozenset({"WARNING", "HANDLED"})
_AGES: Final = frozenset({"STALE", "FRESH"})
"""Codes of one cause, the age of inputs: the newest says how it is."""
CAUSES: Final = 50
"""Most causes of one task that are followed; others are reported one by one."""
_NUMBER: Final = re.compile(r"(?<!\w)\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")


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


class _Cause(Struct):
    """A warning that was reported, and how often it has come again."""

    began_ns: int
    single: int = 1
    times: int = 0
    last: rtpu_messages.Notice | None = None
    """The newest of those that were counted."""


class RepeatedWarnings:
    """The warnings of the tasks of one RTPU.

    A module that warns in every cycle would hide what else happens. Warnings that
    differ in numbers only have one cause. The first ones are events at once; what
    follows within a window becomes one event at its end, with the latest text and a
    count, as long as it goes on.

    Args:
        events: Takes the reports.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._causes: dict[Task, dict[tuple[str, str, int], _Cause]] = {}

    def repeats(self, task: Task, notice: rtpu_messages.Notice, now_ns: int) -> bool:
        """Return whether a report is a warning that was given often in the window.

        It is then counted. A report with other signals is none.
        """
        if notice.code not in _JOINED | _AGES or notice.bits & ~Signal.WARNING:
            return False
        causes = self._causes.setdefault(task, {})
        key = notice.code, _NUMBER.sub("#", notice.text), notice.errnum
        if notice.code in _AGES:
            key = "", "", 0
        known = causes.get(key)
        if known is None:
            if len(causes) < CAUSES:
                causes[key] = _Cause(now_ns)
            return False
        if known.single < SINGLE:
            known.single += 1
            return False
        known.times += 1
        known.last = notice
        where = task.facts.subsystem
        self._events.count(notice.code, subsystem=where, task=task.name)
        return True

    def report(self, now_ns: int) -> None:
        """Report what was repeated in windows that are over."""
        for task, causes in self._causes.items():
            for key, cause in list(causes.items()):
                if now_ns - cause.began_ns < WINDOW_NS:
                    continue
                if cause.times:
                    self._report(task, cause, now_ns)
                    causes[key] = _Cause(now_ns, SINGLE)
                else:
                    del causes[key]

    def end(self, task: Task, now_ns: int) -> None:
        """Report the rest of a task that has ended, and forget it."""
        for cause in self._causes.pop(task, {}).values():
            if cause.times:
                self._report(task, cause, now_ns)

    def _report(self, task: Task, cause: _Cause, now_ns: int) -> None:
        if (last := cause.last) is None:
            return
        seconds = max(1, round((now_ns - cause.began_ns) * 1e-9))
        where = task.facts.subsystem
        self._events.count(last.code, -1, subsystem=where, task=task.name)
        self._events.add(
            Severity(last.severity),
            last.code,
            f"[{cause.times} more in {seconds} s] {last.text}",
            subsystem=where,
            task=task.name,
            errnum=last.errnum,
            place=last.place,
        )
