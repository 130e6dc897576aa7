"""Ports that an RMOD spells otherwise than its module: one cause, reported once.

What follows from it is not reported: that the right name is not listed, that the table
does not have the wrong one, that no task writes what others read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.ports import Kind

from .records import Configuration, Task

if TYPE_CHECKING:
    from collections.abc import Container

KEYWORDS = {
    Kind.INCONST: "INCONST",
    Kind.OUTCONST: "OUTCONST",
    Kind.INVAR: "INVAR",
    Kind.OUTVAR: "OUTVAR",
}
"""The list of the ``.rmod`` file that holds each kind of port."""


def listed(task: Task, keyword: str) -> tuple[str, ...]:
    """Return the ports that one list of the RMOD names."""
    ports: tuple[str, ...] = getattr(task.rmod, keyword.lower())
    return ports


def meant(task: Task, kind: Kind) -> dict[str, str]:
    """Return for each misspelt port of a list the module's port that is meant.

    It is the nearest that the list lacks; one that the module has under another kind is
    no misspelling.
    """
    if task.info is None:
        return {}
    names, declared = listed(task, KEYWORDS[kind]), task.info.named(kind)
    lacking = [name for name in declared if name not in names]
    found: dict[str, str] = {}
    for name in names:
        if name not in declared and not elsewhere(task, name):
            import difflib  # only where something is wrong

            for near in difflib.get_close_matches(name, lacking, n=1):
                found[name] = near
                lacking.remove(near)
    return found


def elsewhere(task: Task, port: str) -> list[str]:
    """Return the lists under which the module has a port of this name."""
    info = task.info
    if info is None:
        return []
    return [KEYWORDS[kind] for kind in Kind if port in info.named(kind)]


def as_meant(configuration: Configuration) -> Configuration:
    """Return the configuration with misspelt ports put right, for whatever follows.

    Where the table has the variable of the RMOD's name alone, it is the module that is
    misspelt, and the RMOD stays.
    """
    table = configuration.table
    tasks = tuple(_as_meant(task, table) for task in configuration.tasks)
    return structs.replace(configuration, tasks=tasks)


def _as_meant(task: Task, table: Container[str]) -> Task:
    lists: dict[str, tuple[str, ...]] = {}
    name_of = task.rmod.svar_name
    for kind, keyword in KEYWORDS.items():
        right = {
            name: near
            for name, near in meant(task, kind).items()
            if name_of(near) in table or name_of(name) not in table
        }
        if right:
            names = listed(task, keyword)
            lists[keyword.lower()] = tuple(right.get(name, name) for name in names)
    if not lists:
        return task
    return structs.replace(task, rmod=structs.replace(task.rmod, **lists))
