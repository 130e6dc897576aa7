"""Execution times of one task by themselves: do they fit into its period?

A task whose every cycle may take longer than its period can keep no deadline, so the
declaration or the frequency is wrong. A soft task may take several periods; what is
reserved for it may not (Stewart 1994, section 6.4).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .demands import is_periodic, is_server
from .records import Code, Problem, Severity, Task

if TYPE_CHECKING:
    from collections.abc import Iterator

SHORTEST_NS = 100_000
"""The shortest period that an RTPU grants (``RT_MIN_PERIOD_NS`` in node/layout.h)."""
_EXACT = 1 + 1e-9


def check_times(task: Task) -> Iterator[Problem]:
    """Yield the times of an RMOD that do not fit the task's period."""
    yield from _too_fast(task)
    if is_periodic(task):
        wanted = "EFFC" if task.rmod.softness else "MAXC"
        found = next(_beyond(task, (wanted, "MINC")), None)
        if found is not None:
            yield found
    elif is_server(task):
        yield from _beyond(task, ("CAPACITY",))
    yield from _understated(task)


def _too_fast(task: Task) -> Iterator[Problem]:
    fastest = 1e9 / SHORTEST_NS
    if task.hz is not None and task.hz > fastest * _EXACT:
        yield Problem(
            code=Code.RATE,
            what=f"task {task.name} has a higher frequency than an RTPU supports",
            where=task.place(
                "FREQ" if task.freq or not _says_period(task) else "PERIOD"
            ),
            expected=f"at most {fastest:g} Hz",
            got=f"{task.hz:g} Hz",
            remedy="lower the frequency",
            tasks=(task.name,),
        )


def _says_period(task: Task) -> bool:
    return "PERIOD" in task.rmod.places


def _beyond(task: Task, keywords: tuple[str, ...]) -> Iterator[Problem]:
    period = 1.0 / task.hz if task.hz else 0.0
    for keyword in keywords:
        seconds: float | None = getattr(task.rmod, keyword.lower())
        if seconds is None or not period or seconds <= period * _EXACT:
            continue
        yield Problem(
            code=Code.TIMES,
            what=f"{keyword} of task {task.name} is above its period",
            where=task.place(keyword),
            expected=f"at most {period:g} s, the period at {task.hz:g} Hz",
            got=f"{seconds:g} s",
            remedy=f"lower the frequency to at most {1 / seconds:.6g} Hz, or correct "
            f"{keyword}{_soften(keyword)}",
            tasks=(task.name,),
        )


def _soften(keyword: str) -> str:
    if keyword != "MAXC":
        return ""
    return "; with SOFTNESS a cycle may continue into the next periods"


def _understated(task: Task) -> Iterator[Problem]:
    """Warn when a cycle was seen to take longer than the declaration."""
    declared, measured = task.rmod.maxc, task.measured
    if declared is None or measured is None or measured <= declared * _EXACT:
        return
    yield Problem(
        code=Code.UNDERSTATED,
        severity=Severity.WARN,
        what=f"a cycle of task {task.name} took longer than its MAXC",
        where=task.place("MAXC"),
        expected=f"at most {declared:g} s",
        got=f"{measured:g} s as measured",
        remedy=f"'pbonet adopt' writes the measured time, or find out why {task.name} "
        "takes so long",
        tasks=(task.name,),
    )
