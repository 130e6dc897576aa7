"""The order in which tasks are spawned, turned on and off, and run (3.5, 6.2.4)."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from pbonet.errors import VerificationError

from . import graph
from .records import Code, Configuration, Problem, Task

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


def _constants(tasks: Sequence[Task]) -> graph.Edges:
    return graph.flows(
        [task.name for task in tasks],
        {task.name: task.gives for task in tasks},
        {task.name: task.needs for task in tasks},
    )


def _data(tasks: Sequence[Task]) -> graph.Edges:
    return graph.flows(
        [task.name for task in tasks],
        {task.name: task.outputs for task in tasks},
        {task.name: task.inputs for task in tasks},
    )


def check_initialization(configuration: Configuration) -> Iterator[Problem]:
    """Yield a cycle of constants, which no order of spawning can satisfy."""
    edges = _constants(configuration.tasks)
    _, left = graph.sort(edges)
    if not left:
        return
    path = graph.cycle(edges, left)
    names = tuple(path[:-1])
    tasks = {task.name: task for task in configuration.tasks}
    yield Problem(
        code=Code.INIT_CYCLE,
        what="the tasks wait for each other's constants"
        if len(names) > 1
        else f"task {path[0]} waits for its own constant",
        where=tasks[path[0]].place("INCONST"),
        expected="constants that flow from task to task without a circle",
        got=graph.draw(edges, path),
        remedy="give one of them its constant by LOCAL or from another task",
        tasks=names,
        variables=tuple(edges[a][b] for a, b in pairwise(path)),
    )


def spawn_order(tasks: Sequence[Task]) -> list[str]:
    """Return the tasks so that constants are produced before they are needed.

    Where constants leave a choice, the given order stays (section 3.5).

    Raises:
        VerificationError: They wait for each other's constants.
    """
    edges = _constants(tasks)
    ordered, left = graph.sort(edges)
    if left:
        raise VerificationError(
            "the tasks wait for each other's constants",
            where=left[0],
            got=graph.draw(edges, graph.cycle(edges, left)),
            remedy="give one of them its constant by LOCAL or from another task",
        )
    return ordered


def spawn_steps(tasks: Sequence[Task]) -> list[list[str]]:
    """Return the tasks in the order of `spawn_order`, those of a step to be at once.

    The tasks of a step are on different RTPUs, and none needs a constant of another.

    Raises:
        VerificationError: They wait for each other's constants.
    """
    homes, edges = {task.name: task.rtpu for task in tasks}, _constants(tasks)
    left: list[str] = spawn_order(tasks)
    steps: list[list[str]] = []
    while left:
        first = {homes[name]: name for name in reversed(left)}
        step: list[str] = [
            name
            for name in left
            if first[homes[name]] == name
            and not any(name in edges[other] for other in left)
        ]
        steps.append(step)
        left = [name for name in left if name not in step]
    return steps


def flow_order(tasks: Sequence[Task]) -> list[str]:
    """Return the tasks in the order in which data flows through them (6.2.4).

    A control loop has no first task, so it is opened where its data comes from: in
    front of its CRITICAL task, which is the one that speaks to the hardware; without
    one in front of the fastest task, then by name.
    """
    known = {task.name: task for task in tasks}

    def rank(name: str) -> tuple[bool, float, str]:
        task = known[name]
        return (not task.rmod.critical, -(task.hz or 0.0), name)

    edges = graph.without_cycles(_data(tasks), rank)
    return graph.sort(edges)[0]


def user_priorities(tasks: Sequence[Task]) -> dict[str, int]:
    """Return a unique user priority for each task; the higher one runs first.

    Among equal criticalities and deadlines a producer then runs before its consumers,
    so that these do not compute with old data (section 6.2.4).
    """
    order = flow_order(tasks)
    return {name: len(order) - index for index, name in enumerate(order)}


def on_order(tasks: Sequence[Task]) -> list[str]:
    """Return the tasks in the order of turning them on.

    Sensors, which read no variable, come first, then computation in the order of its
    data flow, and CRITICAL tasks last, when everything they read is written.
    """
    known = {task.name: task for task in tasks}

    def stage(name: str) -> int:
        if known[name].rmod.critical:
            return 2
        return 1 if known[name].inputs else 0

    return sorted(flow_order(tasks), key=stage)


def off_order(tasks: Sequence[Task], stated: Sequence[str] = ()) -> list[str]:
    """Return the tasks in the order of turning them off.

    Args:
        tasks: The tasks that are ON.
        stated: The order that a job's OFF line states; tasks that it leaves out follow
            in the reverse of `on_order`.
    """
    names = {task.name for task in tasks}
    first = [name for name in stated if name in names]
    return first + [name for name in reversed(on_order(tasks)) if name not in first]


def change_order(
    going: Sequence[Task], coming: Sequence[Task], staying: Sequence[Task] = ()
) -> list[tuple[str, str]]:
    """Return the signals that lead from one configuration to another (section 3.10).

    Tasks are turned on in the order of `on_order`. The writer of an output of one of
    them is turned off directly before it, and the other successors of that one follow
    directly, so that a variable is without a writer for as short a time as can be.
    Tasks without a successor go off at the end: until then other tasks may read them.

    Args:
        going: The tasks that are turned off.
        coming: The tasks that are turned on.
        staying: The tasks that stay ON.

    Returns:
        Pairs of task and signal.
    """
    known = {task.name: task for task in coming}
    left = {task.name: task for task in going}
    todo = [name for name in on_order([*staying, *coming]) if name in known]
    items: list[tuple[str, str]] = []
    while todo:
        new = known[todo.pop(0)]
        before = [
            left.pop(name)
            for name in off_order(list(left.values()))
            if _share_outputs(left[name], new)
        ]
        items += [(task.name, "off") for task in before]
        items.append((new.name, "on"))
        todo.sort(
            key=lambda name: not any(_share_outputs(old, known[name]) for old in before)
        )
    return items + [(name, "off") for name in off_order(list(left.values()))]


def _share_outputs(one: Task, other: Task) -> bool:
    return bool(set(one.outputs) & set(other.outputs))
