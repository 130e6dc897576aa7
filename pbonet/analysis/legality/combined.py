"""The parts of a combination: do they fit each other, and the table (3.8.1, 3.3.1)?

The combination itself is a task like any other. What is checked here is what it hides:
inner variables, and ports of parts behind which a variable stands that another part's
port stands for.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pbonet.pbo import faults
from pbonet.ports import accepts, shape_text, wanted

from .records import Code, Configuration, Problem, Task
from .units import ANY, conversion, same_unit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.config import Variable
    from pbonet.pbo import ModuleInfo, PartInfo
    from pbonet.ports import Port


def check_parts(configuration: Configuration, task: Task) -> Iterator[Problem]:
    """Yield the problems within a combination and of its table."""
    info = task.info
    if info is None or not info.parts:
        return
    told = [one.part for one in info.parts]
    for fault in faults(told, (*task.rmod.outconst, *task.rmod.outvar)):
        yield Problem(
            code=Code.TWO_WRITERS if fault.twice else Code.PARTS,
            what=fault.what,
            where=task.place("COMBINE"),
            expected=fault.expected,
            got=fault.got,
            remedy=fault.remedy,
            tasks=(task.name,),
            variables=(fault.variable,),
        )
    yield from _sync(task, info)
    yield from _inner(task, info)
    yield from _outer(configuration.table, task, info)


def _sync(task: Task, info: ModuleInfo) -> Iterator[Problem]:
    waiting = [one.name for one in info.parts if "sync" in one.info.methods]
    if len(waiting) > 1:
        yield Problem(
            code=Code.NO_METHOD,
            what=f"the parts {' and '.join(waiting)} both write sync",
            where=task.place("COMBINE"),
            expected="at most one part that waits for its event",
            remedy="run the others as separate tasks",
            tasks=(task.name,),
        )


def _uses(info: ModuleInfo) -> Iterator[tuple[PartInfo, Port, str]]:
    """Yield every port of every part, with its variable."""
    for one in info.parts:
        for port in one.info.ports:
            yield one, port, one.variables[port.name]


def _inner(task: Task, info: ModuleInfo) -> Iterator[Problem]:
    """Compare the ports of each inner variable with its writer's."""
    inner = {port.name for port in info.inner}
    writers = {v: (p, q) for p, q, v in _uses(info) if not q.kind.is_input}
    for part, port, variable in _uses(info):
        if variable not in inner or not port.kind.is_input or variable not in writers:
            continue
        by, writer = writers[variable]
        names = f"{by.name}.{writer.name}", f"{part.name}.{port.name}"
        for code, what, expected, got, remedy in _differences(writer, port):
            yield Problem(
                code=code,
                what=f"{names[0]} and {names[1]}, which the inner variable {variable} "
                f"connects, have different {what}",
                where=task.place("COMBINE"),
                expected=f"{expected} as {names[0]} has",
                got=got,
                remedy=remedy,
                tasks=(task.name,),
                ports=names,
                variables=(variable,),
            )


def _differences(
    writer: Port, reader: Port
) -> Iterator[tuple[Code, str, str, str, str]]:
    kinds = {"float": "f8", "int": "i8", "bool": "b1"}
    held = kinds.get(writer.type, writer.type.removesuffix("[]"))
    if not accepts(reader, held):
        yield Code.TYPE, "types", writer.type, reader.type, "connect others"
    if ANY not in {writer.unit, reader.unit} and not same_unit(
        writer.unit, reader.unit
    ):
        factor = conversion(writer.unit, reader.unit)
        remedy = "insert a module that converts"
        yield (
            Code.UNIT,
            "units",
            writer.unit,
            reader.unit,
            f"{factor}; {remedy}" if factor else remedy,
        )
    one, other = _size(writer), _size(reader)
    if one and other and one != other:
        shapes = shape_text(writer.shape), shape_text(reader.shape)
        yield Code.SHAPE, "sizes", *shapes, "connect others"


def _size(port: Port) -> int:
    """Return how many elements a port has, 0 where that depends on the table."""
    return math.prod(dim if isinstance(dim, int) else 0 for dim in port.shape)


def _outer(
    table: dict[str, Variable], task: Task, info: ModuleInfo
) -> Iterator[Problem]:
    """Compare ports of parts that have another name outside with the table."""
    shown = {port.name: port for port in info.ports}
    for part, port, name in _uses(info):
        variable = table.get(task.rmod.svar_name(name))
        if variable is None or name not in shown:
            continue
        unit = port.unit if same_unit(shown[name].unit, variable.units) else ANY
        if not accepts(port, variable.dtype):
            odd = Code.TYPE, wanted(port), variable.type
        elif ANY not in {unit, variable.units} and not same_unit(unit, variable.units):
            odd = Code.UNIT, unit, variable.units
        else:
            continue
        code, expected, got = odd
        about = f"{part.name}.{port.name}"
        yield Problem(
            code=code,
            what=f"the port {about} within task {task.name} does not fit the variable "
            f"{variable.name}",
            where=task.place("COMBINE"),
            expected=expected,
            got=f"{got} ({variable.place or 'the .svar file'})",
            remedy="connect another variable, or insert a module that converts",
            tasks=(task.name,),
            ports=(about,),
            variables=(variable.name,),
        )
