"""Writers and readers of variables: equations 1 and 2 (section 3.3.1), and constants.

Both equations speak of the tasks that are ON. Constants are written once, when a task
is spawned, so they are judged over all existing tasks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .joins import remedy
from .records import Code, Configuration, Problem, Severity, Task

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from pbonet.config import Rmod


def producers(rmods: Iterable[Rmod]) -> dict[str, tuple[str, ...]]:
    """Return which of these RMODs write a variable or constant, by variable."""
    found: dict[str, list[str]] = {}
    for rmod in rmods:
        for port in (*rmod.outvar, *rmod.outconst):
            found.setdefault(rmod.svar_name(port), []).append(rmod.name)
    return {variable: tuple(names) for variable, names in found.items()}


def check_writers(configuration: Configuration) -> Iterator[Problem]:
    """Yield variables that two tasks write (equation 1)."""
    writers = _by_variable(configuration.running, "OUTVAR")
    owned_constants = _by_variable(configuration.tasks, "OUTCONST")
    for variable, tasks in writers.items():
        constant = [t for t in owned_constants.get(variable, []) if t not in tasks]
        if len(tasks) + len(constant) > 1:
            yield _two_writers(configuration, variable, tasks, constant)
    for variable, tasks in owned_constants.items():
        if len(tasks) > 1:
            yield _two_givers(variable, tasks)


def _by_variable(tasks: Iterable[Task], keyword: str) -> dict[str, list[Task]]:
    found: dict[str, list[Task]] = {}
    for task in tasks:
        names = task.outputs if keyword == "OUTVAR" else task.gives
        for variable in names:
            found.setdefault(variable, []).append(task)
    return found


def _two_writers(
    configuration: Configuration,
    variable: str,
    tasks: list[Task],
    constant: list[Task],
) -> Problem:
    names = [task.name for task in (*tasks, *constant)]
    places = [task.place("OUTVAR") for task in tasks]
    places += [task.place("OUTCONST") for task in constant]
    return Problem(
        code=Code.TWO_WRITERS,
        what=f"{_list(names)} all write {variable}"
        if len(names) > 2  # noqa: PLR2004 - grammar
        else f"{_list(names)} both write {variable}",
        where=places[-1],
        expected="one task that writes a variable (equation 1)",
        got=f"{len(names)}: {', '.join(places)}",
        remedy=_swap_back(tasks)
        or (
            remedy(configuration, variable, tasks)
            if len(tasks) > 1
            else "rename one by SVARALIAS"
        ),
        tasks=tuple(names),
        ports=tuple(task.port("OUTVAR", variable) for task in tasks),
        variables=(variable,),
    )


def _swap_back(tasks: list[Task]) -> str:
    """Return the remedy if one of the tasks is another one's fallback; else empty."""
    for spare in tasks:
        original = spare.fallback_of
        if original in {task.name for task in tasks}:
            return (
                f"`swap {spare.name} {original}` lets {original} take over again, and "
                f"its fallback {spare.name} stands by"
            )
    return ""


def _two_givers(variable: str, tasks: list[Task]) -> Problem:
    names = [task.name for task in tasks]
    return Problem(
        code=Code.TWO_CONSTANTS,
        severity=Severity.WARN,
        what=f"{_list(names)} both produce the constant {variable}; they must give it "
        "the same value, because the table refuses another value",
        where=tasks[-1].place("OUTCONST"),
        expected="one value of a constant",
        got=", ".join(task.place("OUTCONST") for task in tasks),
        remedy="where values differ, swap one for the other, kill one of them, or give "
        "its constant another name by SVARALIAS",
        tasks=tuple(names),
        ports=tuple(task.port("OUTCONST", variable) for task in tasks),
        variables=(variable,),
    )


def check_readers(configuration: Configuration) -> Iterator[Problem]:
    """Yield variables that tasks read and no task writes (equation 2)."""
    written = {name for task in configuration.running for name in task.outputs}
    written |= {name for task in configuration.tasks for name in task.gives}
    readers: dict[str, list[Task]] = {}
    for task in configuration.running:
        for variable in task.inputs:
            if variable not in written:
                readers.setdefault(variable, []).append(task)
    alike: dict[tuple[str, ...], list[str]] = {}  # the same readers, the same advice
    for variable, tasks in readers.items():
        key = (_who_writes(configuration, variable), *(task.name for task in tasks))
        alike.setdefault(key, []).append(variable)
    for (advice, *names), variables in alike.items():
        tasks = readers[variables[0]]
        verb = "reads" if len(names) == 1 else "read"
        *most, last = variables
        told = f"{', '.join(most)} and {last}" if most else last
        yield Problem(
            code=Code.NO_WRITER,
            what=f"no task that is ON writes {told}, which {_list(names)} {verb}",
            where=tasks[0].place("INVAR"),
            expected="a task that writes each variable that is read (equation 2)",
            remedy=advice,
            tasks=tuple(names),
            ports=tuple(t.port("INVAR", name) for name in variables for t in tasks),
            variables=tuple(variables),
        )


def _who_writes(configuration: Configuration, variable: str) -> str:
    standing = [t.name for t in configuration.tasks if variable in t.outputs]
    if standing:
        return f"turn {' or '.join(standing)} on"
    return _from_library(configuration, variable)


def _from_library(configuration: Configuration, variable: str) -> str:
    rmods = configuration.producers.get(variable, ())
    if rmods:
        verb, it = ("does", "it") if len(rmods) == 1 else ("do", "one of them")
        return f"in the library, {_list(rmods)} {verb}; add {it} to the configuration"
    return f"add a task that writes {variable}, or rename the port by SVARALIAS"


def check_constants(configuration: Configuration) -> Iterator[Problem]:
    """Yield constants that tasks need and no task produces.

    A constant with an INIT line in the ``.svar`` file has that value, which is
    reported.
    """
    produced = {name for task in configuration.tasks for name in task.gives}
    for task in configuration.tasks:
        for variable in task.needs:
            if variable not in produced:
                yield _no_constant(configuration, task, variable)


def _no_constant(configuration: Configuration, task: Task, variable: str) -> Problem:
    known = configuration.table.get(variable)
    if known is not None and known.init is not None:
        return Problem(
            code=Code.NO_CONSTANT,
            severity=Severity.WARN,
            what=f"no task produces the constant {variable}, which {task.name} needs; "
            "it has the value of its INIT line",
            where=task.place("INCONST"),
            remedy=_from_library(configuration, variable),
            tasks=(task.name,),
            ports=(task.port("INCONST", variable),),
            variables=(variable,),
        )
    writers = [other.name for other in configuration.tasks if variable in other.outputs]
    return Problem(
        code=Code.NO_CONSTANT,
        what=f"no task produces the constant {variable}, which {task.name} needs",
        where=task.place("INCONST"),
        expected="an existing task with it as an out-const",
        got=f"{_list(writers)} with it as an out-var" if writers else "",
        remedy=f"{_from_library(configuration, variable)}, or give it a value by INIT "
        "in the .svar file",
        tasks=(task.name,),
        ports=(task.port("INCONST", variable),),
        variables=(variable,),
    )


def _list(names: Iterable[str]) -> str:
    return " and ".join(names)
