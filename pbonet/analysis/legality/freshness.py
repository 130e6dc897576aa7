"""Circles of tasks in which ages would never end, or that would hold for ever.

An out-var has the age of the oldest input that it was computed from. In a circle in
which no task makes new information that age only grows. And tasks of a circle that all
skip their cycles while an input is too old wait for each other.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from pbonet.config import stale_action
from pbonet.ports import Kind, Stale

from . import graph
from .records import Code, Problem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from pbonet.config import Variable
    from pbonet.ports import Port

    from .records import Configuration, Task


def max_age(port: Port, variable: Variable | None) -> float | None:
    """Return the limit of an in-var in seconds, the tighter one; None: it has none."""
    given = (port.max_age, variable.maxage if variable else None)
    return min((age for age in given if age is not None), default=None)


def passes(task: Task, port: Port) -> bool:
    """Return whether the age of an in-var is passed on to what the task writes."""
    own = task.rmod.svar_name(port.name) in task.outputs
    return not (port.feedback or own or _is_new(task))


def check_circles(configuration: Configuration) -> Iterator[Problem]:
    """Yield the circles of running tasks that would make each other stale for ever."""
    table, tasks = configuration.table, configuration.running

    def limited(task: Task, port: Port) -> bool:
        return max_age(port, table.get(task.rmod.svar_name(port.name))) is not None

    def holds(task: Task, port: Port) -> bool:
        info = task.info
        action = stale_action(task.rmod, info, port) if info else ""
        return action == Stale.HOLD and limited(task, port)

    inheriting = [task for task in tasks if not _is_new(task)]
    for path, edges in _circles(inheriting, passes):
        members = [task for task in inheriting if task.name in path]
        written = {variable for task in members for variable in task.outputs}
        counts = any(passes(t, p) and limited(t, p) for t in members for p in _ins(t))
        ends = any(
            limited(task, port) and task.rmod.svar_name(port.name) in written
            for task in tasks
            for port in _ins(task)
        )
        if counts and ends:
            yield _stamp_loop(members[0], path, edges)
    for path, edges in _circles(tasks, holds):
        first = next(task for task in tasks if task.name == path[0])
        yield _hold_loop(first, path, edges)


def _is_new(task: Task) -> bool:
    ports = task.info.ports if task.info else ()
    return all(port.new for port in ports if port.kind is Kind.OUTVAR)


def _ins(task: Task) -> list[Port]:
    ports = task.info.ports if task.info else ()
    return [port for port in ports if port.kind is Kind.INVAR]


def _circles(
    tasks: Sequence[Task], counts: Callable[[Task, Port], bool]
) -> Iterator[tuple[list[str], graph.Edges]]:
    """Yield one circle for each set of tasks that reach each other by such inputs."""
    edges = graph.flows(
        [task.name for task in tasks],
        {task.name: task.outputs for task in tasks},
        {
            task.name: [
                task.rmod.svar_name(port.name)
                for port in _ins(task)
                if counts(task, port)
                and task.rmod.svar_name(port.name) not in task.outputs
            ]
            for task in tasks
        },
    )
    for group in graph.groups(edges):
        yield graph.cycle(edges, [name for name in edges if name in group]), edges


def _stamp_loop(task: Task, path: list[str], edges: graph.Edges) -> Problem:
    return Problem(
        code=Code.STAMP_LOOP,
        what=f"the tasks {' and '.join(path[:-1])} pass on each other's age, which "
        "would only grow",
        where=task.place("OUTVAR"),
        expected="a task in the circle that measures, or starts from its own state",
        got=graph.draw(edges, path),
        remedy="write OutVar(..., new=True) where a value is measured, such as in the "
        "robot's interface, or InVar(..., feedback=True) where it only feeds back",
        tasks=tuple(path[:-1]),
        variables=tuple(edges[a][b] for a, b in pairwise(path)),
    )


def _hold_loop(task: Task, path: list[str], edges: graph.Edges) -> Problem:
    return Problem(
        code=Code.HOLD_LOOP,
        what=f"the tasks {' and '.join(path[:-1])} hold while the input from each "
        "other is too old, and would never go on after an interruption",
        where=task.place("STALE"),
        expected="a task in the circle that goes on, or does stable or safe",
        got=graph.draw(edges, path),
        remedy="write another action after STALE in one of their .rmod files",
        tasks=tuple(path[:-1]),
        variables=tuple(edges[a][b] for a, b in pairwise(path)),
    )
