"""Sizes: do the shapes of a task's ports fit the table, and do the tasks agree?"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pbonet.errors import PortError
from pbonet.ports import solve_shapes

from .misspelled_ports import KEYWORDS, listed
from .records import Code, Configuration, Problem, Task

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from pbonet.pbo import ModuleInfo
    from pbonet.ports import Port


def check_shapes(configuration: Configuration) -> Iterator[Problem]:
    """Yield ports with the wrong shape, and constants on which tasks disagree.

    A name in a shape is one size in a module. If it is a constant's, it is one size in
    the whole configuration, because all tasks read the same constant.
    """
    problems, sizes = _solve_all(configuration)
    yield from problems
    for variable, found in sizes.items():
        if len(found) > 1:
            yield _disagreement(variable, found)


def constant_sizes(configuration: Configuration) -> dict[str, int]:
    """Return the sizes that constants must have, by variable, as most tasks see it."""
    _, sizes = _solve_all(configuration)
    return {
        variable: max(found, key=lambda size: len(found[size]))
        for variable, found in sizes.items()
    }


def _solve_all(
    configuration: Configuration,
) -> tuple[list[Problem], dict[str, dict[int, list[str]]]]:
    """Return tasks' problems, and by constant and size the tasks that see it so."""
    problems: list[Problem] = []
    sizes: dict[str, dict[int, list[str]]] = {}
    for task in configuration.tasks:
        if task.info is None:
            continue
        solved = _solve(configuration, task, task.info)
        if isinstance(solved, Problem):
            problems.append(solved)
            continue
        for variable, size in solved.items():
            sizes.setdefault(variable, {}).setdefault(size, []).append(task.name)
    return problems, sizes


def _solve(
    configuration: Configuration, task: Task, info: ModuleInfo
) -> Problem | dict[str, int]:
    """Return the sizes that constants must have, by variable, or the problems."""
    table = configuration.table
    nelem: dict[str, int] = {}
    for port in info.ports:
        variable = table.get(task.rmod.svar_name(port.name))
        if variable is None or port.name not in listed(task, KEYWORDS[port.kind]):
            return {}  # told as such by `parts`
        nelem[port.name] = variable.nelem
    try:
        shapes = solve_shapes(
            (*info.ports, *info.within),
            nelem,
            _initial(configuration, task, info),
            where=task.name,
        )
        _compare(task, info, shapes)
    except PortError as error:
        return _misfit(configuration, task, info, error)
    constants = {
        name: task.rmod.svar_name(port.name)
        for port in info.ports
        if port.kind.is_const
        for name in (port.attr, port.name)
    }
    return {
        constants[name]: size
        for port in info.ports
        for name, size in zip(port.shape, shapes[port.attr], strict=True)
        if isinstance(name, str) and name in constants
    }


def _misfit(
    configuration: Configuration, task: Task, info: ModuleInfo, error: PortError
) -> Problem:
    """Return the problem of a port that does not fit, with the lines of both sides."""
    table = configuration.table
    named = [p for p in info.ports if f"port {p.attr} ({p.name}) " in f"{error.what} "]
    where = f"{task.place(KEYWORDS[named[0].kind])}: " if named else ""
    sides = [table[task.rmod.svar_name(port.name)] for port in named]
    at = ", ".join(f"{one.name} {one.place}" for one in sides if one.place)
    return Problem(
        code=Code.SHAPE,
        what=error.what,
        where=f"{where}{task.name}",
        expected=error.expected,
        got=f"{error.got} ({at})" if at else error.got,
        remedy=error.remedy or "correct NELEM in the .svar file, or connect others",
        tasks=(task.name,),
        ports=tuple(port.name for port in named),
        variables=tuple(one.name for one in sides),
    )


def _compare(
    task: Task, info: ModuleInfo, shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Refuse an inner variable that two parts of a combination size differently.

    Raises:
        PortError: There is one.
    """
    first: dict[str, Port] = {}
    inner = {port.name for port in info.inner}
    for port in (port for port in info.within if port.name in inner):
        other = first.setdefault(port.name, port)
        one, two = math.prod(shapes[other.attr]), math.prod(shapes[port.attr])
        if one != two:
            raise PortError(
                f"the inner variable {port.name} has two sizes",
                where=task.name,
                expected=f"{one} elements as {other.attr} has",
                got=f"{two} as {port.attr} has",
                remedy="connect others",
            )


def _initial(
    configuration: Configuration, task: Task, info: ModuleInfo
) -> dict[str, int]:
    """Return sizes of constants without a producer, from the table's INIT lines."""
    produced, table = configuration.given, configuration.table
    known: dict[str, int] = {}
    for port in info.ports:
        name = task.rmod.svar_name(port.name)
        init = table[name].init
        if port.is_size and init and name not in produced:
            known[port.name] = int(init[0])
    return known


def _disagreement(variable: str, found: dict[int, list[str]]) -> Problem:
    """Return the problem of one constant that is two sizes."""
    (size, tasks), *others = sorted(found.items(), key=lambda item: -len(item[1]))
    return Problem(
        code=Code.CONSTANT_SIZE,
        what=f"the constant {variable} cannot be the size of all its users",
        where=variable,
        expected=f"{size} as for {' and '.join(tasks)}",
        got=", ".join(f"{other} for {' and '.join(them)}" for other, them in others),
        remedy="give the variables of these tasks the same NELEM, or connect one of "
        "them to another constant by SVARALIAS",
        tasks=tuple(name for them in found.values() for name in them),
        variables=(variable,),
    )
