"""Standbys that take over by themselves from a task on another RTPU (``TAKEOVER``).

Where the two are on different machines, a cut leaves both running. So the one that
takes over must be sure that the other one has ended its cycles by then: it is CRITICAL,
and its machine has been without the keeper's for longer than ``ALONE``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .records import Code, Configuration, Problem, Task

if TYPE_CHECKING:
    from collections.abc import Iterator

MARGIN = 1.0
"""Seconds by which ``TAKEOVER`` is longer than ``ALONE``, at least: until a loss is
noticed, and the last cycle has ended."""


def check_standbys(configuration: Configuration) -> Iterator[Problem]:
    """Yield standbys that cannot take over by themselves as the job says."""
    tasks = {task.name: task for task in configuration.tasks}
    for standby in configuration.tasks:
        original = tasks.get(standby.fallback_of)
        if original is None or not standby.takeover:
            continue
        if fault := _fault(configuration, standby, original):
            what, expected, got, remedy = fault
            yield Problem(
                code=Code.FALLBACK_RTPU,
                what=f"{standby.name} cannot take over from {original.name} by itself: "
                f"{what}",
                where=str(original.job_places.get("RTPU") or original.rmod.file),
                expected=expected,
                got=got,
                remedy=remedy,
                tasks=(standby.name,),
            )


def _fault(
    now: Configuration, standby: Task, original: Task
) -> tuple[str, str, str, str] | None:
    """Return what is wrong, what is expected, what is there, and the remedy."""
    if standby.rtpu == original.rtpu:
        return (
            "TAKEOVER is for the loss of another RTPU",
            "a standby on another RTPU, or no TAKEOVER",
            f"both on {standby.rtpu}",
            f"write RTPU and the other one's name in {standby.rmod.name}.rmod, or "
            "remove TAKEOVER: on one RTPU it takes over at once",
        )
    here = now.machines.get(standby.rtpu)
    there = now.machines.get(original.rtpu)
    if not (here and there) or here == there:
        return None  # a start knows the machines
    if there == now.machines.get(now.keeper):
        return (
            f"the machine of {original.rtpu} has the keeper {now.keeper}, so it is "
            "never alone, and would go on when it is cut off",
            "the keeper on another machine than the original",
            f"keeper {now.keeper}",
            f"name {standby.rtpu}, or an RTPU of a third machine, with MASTER in the "
            ".sbs file, or remove TAKEOVER and use swap",
        )
    least = now.alone + MARGIN
    if not now.alone or standby.takeover < least:
        return (
            "when it is cut off, the original must have ended its cycles before",
            f"TAKEOVER of at least {least:g} s (ALONE and {MARGIN:g} s)"
            if now.alone
            else "ALONE with a time",
            f"TAKEOVER {standby.takeover:g}, ALONE "
            + (f"{now.alone:g}" if now.alone else "never"),
            "make TAKEOVER longer"
            if now.alone
            else "give ALONE a time in the .sbs file, or remove TAKEOVER and use swap",
        )
    if not original.rmod.critical:
        return (
            f"{original.name} is not CRITICAL, so it would go on when it is cut off",
            "CRITICAL",
            "a task that is not",
            f"write CRITICAL in {original.rmod.name}.rmod, or remove TAKEOVER and use "
            "swap",
        )
    return None
