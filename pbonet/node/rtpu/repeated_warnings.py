"""Warnings of one cause that a task repeats: reported at once, then joined.

A module that warns in every cycle would hide what else happens. Warnings that differ in
numbers only have one cause. The first ones are events at once; what follows within a
window becomes one event at its end, with the latest text and a count, as long as it
goes on.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.errors import Severity
from pbonet.pbo import Signal

if TYPE_CHECKING:
    from pbonet.node.wire import EventLog, rtpu_messages

    from .task_handle import Task

WINDOW_NS: Final = 10_000_000_000
"""Nanoseconds in which warnings of one cause become one event."""
SINGLE: Final = 3
"""Warnings of one cause that are reported one by one, before they are joined."""
_JOINED: Final = frozenset({"WARNING", "HANDLED"})
CAUSES: Final = 50
"""Most causes of one task that are followed; others are reported one by one."""
_NUMBER: Final = re.compile(r"(?<!\w)\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")


class _Cause(Struct):
    """A warning that was reported, and how often it has come again."""

    code: str
    began_ns: int
    single: int = 1
    last: str = ""
    times: int = 0
    errnum: int = 0
    place: str = ""


class RepeatedWarnings:
    """The warnings of the tasks of one RTPU.

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
        if notice.code not in _JOINED or notice.bits & ~Signal.WARNING:
            return False
        causes = self._causes.setdefault(task, {})
        key = notice.code, _NUMBER.sub("#", notice.text), notice.errnum
        known = causes.get(key)
        if known is None:
            if len(causes) < CAUSES:
                causes[key] = _Cause(notice.code, now_ns)
            return False
        if known.single < SINGLE:
            known.single += 1
            return False
        known.times += 1
        known.last = notice.text
        known.errnum, known.place = notice.errnum, notice.place
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
                    causes[key] = _Cause(cause.code, now_ns, SINGLE)
                else:
                    del causes[key]

    def end(self, task: Task, now_ns: int) -> None:
        """Report the rest of a task that has ended, and forget it."""
        for cause in self._causes.pop(task, {}).values():
            if cause.times:
                self._report(task, cause, now_ns)

    def _report(self, task: Task, cause: _Cause, now_ns: int) -> None:
        seconds = max(1, round((now_ns - cause.began_ns) * 1e-9))
        where = task.facts.subsystem
        self._events.count(cause.code, -1, subsystem=where, task=task.name)
        self._events.add(
            Severity.WARNING,
            cause.code,
            f"[{cause.times} more in {seconds} s] {cause.last}",
            subsystem=where,
            task=task.name,
            errnum=cause.errnum,
            place=cause.place,
        )
