"""One task by itself: its ports, their variables, types and units, where it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import Limit, missing_methods, numpy_type
from pbonet.errors import did_you_mean
from pbonet.ports import Kind, Port, accepts, wanted

from .combined import check_parts
from .misspelled_ports import KEYWORDS, elsewhere, listed, meant
from .records import Code, Configuration, Problem, Task
from .units import ANY, conversion, same_unit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.config import Variable
    from pbonet.pbo import ModuleInfo


def check_task(configuration: Configuration, task: Task) -> Iterator[Problem]:
    """Yield what else is wrong with one task, whatever the others are."""
    yield from _rtpu(configuration, task)
    if task.info is not None:
        yield from _stable(task, task.info)
        yield from _methods(task, task.info)
        yield from _safe_values(configuration.table, task, task.info)
        yield from check_parts(configuration, task)
    for kind, keyword in KEYWORDS.items():
        yield from _variables(configuration.table, task, kind, keyword)


def _rtpu(configuration: Configuration, task: Task) -> Iterator[Problem]:
    names = [rtpu.name for rtpu in configuration.rtpus]
    if names and task.rtpu not in names:
        yield Problem(
            code=Code.UNKNOWN_RTPU,
            what=f"task {task.name} is to run on {task.rtpu}, which the subsystem "
            "does not have",
            where=task.place("RTPU"),
            expected=" or ".join(names),
            got=task.rtpu,
            remedy=did_you_mean(task.rtpu, names)
            or "name a listed one, or add an RTPU line to the .sbs file",
            tasks=(task.name,),
        )


def _stable(task: Task, info: ModuleInfo) -> Iterator[Problem]:
    if task.rmod.critical and not info.critical_ok:
        yield Problem(
            code=Code.NO_STABLE,
            what=f"task {task.name} is CRITICAL, but its module {info.name} has no "
            "stable()",
            where=task.place("CRITICAL"),
            expected="a module that says what it does while the configuration is "
            "illegal",
            remedy=f"write stable(self, dt) in {info.name}, or take CRITICAL out",
            tasks=(task.name,),
        )


def _methods(task: Task, info: ModuleInfo) -> Iterator[Problem]:
    for what, where, expected, remedy in missing_methods(task.rmod, info):
        yield Problem(
            code=Code.NO_METHOD,
            what=what,
            where=where,
            expected=expected,
            remedy=remedy,
            tasks=(task.name,),
        )


def _safe_values(
    table: dict[str, Variable], task: Task, info: ModuleInfo
) -> Iterator[Problem]:
    """Yield the safe values for SAFE that the table would refuse of the task itself."""
    for port in info.ports:
        variable = table.get(task.rmod.svar_name(port.name))
        if not task.rmod.safe_at or port.safe is None or variable is None:
            continue
        if _within(variable, port.safe):
            continue
        yield Problem(
            code=Code.SAFE_VALUE,
            what=f"the safe value of {port.name} in {info.name} is outside the limits "
            f"of {variable.name}",
            where=task.place("SAFE"),
            expected=f"{variable.min} to {variable.max}",
            got=str(port.safe),
            remedy="write a safe value within them, or other limits in the .svar file",
            tasks=(task.name,),
            ports=(port.name,),
            variables=(variable.name,),
        )


def _within(variable: Variable, values: tuple[float, ...]) -> bool:
    """Return whether values, or one for each element, keep the variable's LIMIT."""
    if variable.limit is Limit.NONE or not variable.min or not variable.max:
        return True
    each = values * variable.nelem if len(values) == 1 else values
    limits = zip(each, variable.min, variable.max, strict=False)
    return all(low <= one <= high for one, low, high in limits)


def check_ports(task: Task) -> Iterator[Problem]:
    """Compare the lists of the RMOD with the ports of the class, both ways.

    A port that stands in the wrong list, or is misspelt, is reported once.
    """
    info = task.info
    if info is None:
        return
    astray = {
        port
        for kind, keyword in KEYWORDS.items()
        for port in listed(task, keyword)
        if port not in info.named(kind)
    }
    for kind, keyword in KEYWORDS.items():
        given, declared = listed(task, keyword), info.named(kind)
        misspelt = meant(task, kind)
        for port in given:
            if port not in declared:
                near = (misspelt[port],) if port in misspelt else declared
                yield _surplus(task, info, keyword, port, near)
        for port in declared:
            if port not in {*given, *astray, *misspelt.values()}:
                yield Problem(
                    code=Code.PORTS,
                    what=f"{keyword} does not list {port}, an {kind.value} of the "
                    f"module {info.name}",
                    where=task.place(keyword),
                    expected=" ".join(declared),
                    got=" ".join(given) or "none",
                    remedy=f"add {port} to {keyword}",
                    tasks=(task.name,),
                    ports=(port,),
                )


def _surplus(
    task: Task, info: ModuleInfo, keyword: str, port: str, near: tuple[str, ...]
) -> Problem:
    """Return the problem of a port that the class does not have there."""
    other = elsewhere(task, port)
    declared = info.named(Kind[keyword])
    about = f"{task.rmod.name}.rmod" if info.parts else info.name
    without = "take it out" if declared else f"write {keyword} none"
    return Problem(
        code=Code.PORTS,
        what=f"{keyword} lists {port}, which is not a port of that kind in module "
        f"{info.name}",
        where=task.place(keyword),
        expected=" ".join(declared) or "none",
        got=" ".join(listed(task, keyword)),
        remedy=f"list it under {' and '.join(other)}"
        if other
        else did_you_mean(port, near)
        or f"{without}; 'pbonet library {about}' shows the ports",
        tasks=(task.name,),
        ports=(port,),
    )


def _variables(
    table: dict[str, Variable], task: Task, kind: Kind, keyword: str
) -> Iterator[Problem]:
    """Check the variables of one list of ports."""
    ports = {} if task.info is None else {
        port.name: port for port in task.info.ports if port.kind is kind
    }  # fmt: skip
    for name in listed(task, keyword):
        variable = table.get(task.rmod.svar_name(name))
        if variable is None and (task.info is None or elsewhere(task, name)):
            yield _unknown(table, task, keyword, name)
        elif variable is None:
            continue  # the module has no such port, which is reported
        elif port := ports.get(name):
            yield from _type(task, keyword, port, variable)
            yield from _unit(task, keyword, port, variable)


def _unknown(
    table: dict[str, Variable], task: Task, keyword: str, port: str
) -> Problem:
    name = task.rmod.svar_name(port)
    behind = f" for its port {port}" if name != port else ""
    near = did_you_mean(name, table)
    remedy = f"add {name} to the .svar file, or rename the port by SVARALIAS"
    return Problem(
        code=Code.UNKNOWN_VARIABLE,
        what=f"task {task.name} uses the variable {name}{behind}, which the table "
        "does not have",
        where=task.place(keyword),
        expected="a variable of the .svar file",
        got=name,
        remedy=f"{near} Else {remedy}" if near else remedy,
        tasks=(task.name,),
        ports=(port,),
        variables=(name,),
    )


def _type(
    task: Task, keyword: str, port: Port, variable: Variable
) -> Iterator[Problem]:
    if accepts(port, numpy_type(variable.type)):
        return
    yield Problem(
        code=Code.TYPE,
        what=f"the port {port.name} of task {task.name} cannot hold the variable "
        f"{variable.name}",
        where=task.place(keyword),
        expected=wanted(port),
        got=f"{variable.type} ({_at(variable)})",
        remedy="correct the variable's TYPE or connect another one",
        tasks=(task.name,),
        ports=(port.name,),
        variables=(variable.name,),
    )


def _unit(
    task: Task, keyword: str, port: Port, variable: Variable
) -> Iterator[Problem]:
    if variable.units == ANY or same_unit(port.unit, variable.units):
        return
    factor = conversion(variable.units, port.unit)
    yield Problem(
        code=Code.UNIT,
        what=f"the port {port.name} of task {task.name} and the variable "
        f"{variable.name} have different units",
        where=task.place(keyword),
        expected=port.unit,
        got=f"{variable.units} ({_at(variable)})",
        remedy=(f"{factor}; " if factor else "")
        + "correct UNITS, or insert a module that converts",
        tasks=(task.name,),
        ports=(port.name,),
        variables=(variable.name,),
    )


def _at(variable: Variable) -> str:
    return str(variable.place or "the .svar file")
