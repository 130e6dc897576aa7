"""Joins of writers of one variable (Stewart 1994, section 3.3, Figure 3.6)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import MAX_NAME, numpy_type

from .records import Code, Problem, Severity
from .units import ANY, conversion, same_unit

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pbonet.pbo import ModuleInfo

    from .records import Configuration, Task

BY_AGE = "join_first"
"""The connector that takes an input for valid while it is not too old."""
CONNECTORS = ("join_average", "join_first", "join_max", "join_min")
"""The join connectors of the library: `Z1` and `Z2` in, `Z` out, all of them double."""


def remedy(configuration: Configuration, variable: str, tasks: Sequence[Task]) -> str:
    """Return how to put join connectors after the writers, with the lines to write.

    A connector takes two inputs, so several writers need a chain of them.
    """
    links = len(tasks) - 1
    names = intermediate(variable, len(tasks) + links - 1)
    aliases = [
        f"SVARALIAS {task.port('OUTVAR', variable)}={name} in {task.rmod.name}.rmod"
        for task, name in zip(tasks, names, strict=False)
    ]
    known = configuration.table.get(variable)
    fits = known is None or numpy_type(known.type) == "<f8"
    one = f"{' or '.join(CONNECTORS)}" if fits else "one of your own for its type"
    connectors = "a join connector" if links == 1 else f"{links} join connectors"
    return (
        f"turn {'one' if links == 1 else 'all but one'} off, or join them: "
        f"{', '.join(aliases)}; {' '.join(names)} beside {variable} in the .svar file; "
        f"{connectors} ({one}) with {' and '.join(_chain(names, variable, links))}"
    )


def _chain(names: Sequence[str], variable: str, links: int) -> list[str]:
    """Return the aliases of each connector; all but the last feed the next one."""
    inputs, between = names[: links + 1], [*names[links + 1 :], variable]
    lines: list[str] = []
    first = inputs[0]
    for second, out in zip(inputs[1:], between, strict=True):
        lines.append(f"SVARALIAS Z1={first}, SVARALIAS Z2={second}, SVARALIAS Z={out}")
        first = out
    return lines


def check_ages(configuration: Configuration) -> Iterator[Problem]:
    """Yield inputs that a connector takes for valid even without a writer.

    Only the last connector of a chain may continue with a value of any age, its Z2:
    there is nothing to fall back to after it.
    """
    for task in configuration.tasks:
        if task.rmod.module != BY_AGE:
            continue
        variable = task.rmod.svar_name("Z1")
        known = configuration.table.get(variable)
        if known is None or known.maxage is not None:
            continue
        yield Problem(
            code=Code.NO_MAXAGE,
            severity=Severity.WARN,
            what=f"{variable} has no MAXAGE, so {task.name} considers it valid even "
            "when no task writes it any more, and never falls back for that",
            where=task.place("INVAR"),
            remedy=f"write MAXAGE and seconds under NAME {variable} in the .svar file",
            tasks=(task.name,),
            ports=("Z1",),
            variables=(variable,),
        )


def intermediate(variable: str, count: int) -> list[str]:
    """Return names for the variables before a join connector: ``x'``, ``x''`` ..."""
    names: list[str] = []
    for number in range(1, count + 1):
        mark = "'" * number if count <= 3 else f"'{number}"  # noqa: PLR2004 - x''''
        names.append(variable[: MAX_NAME - len(mark)] + mark)
    return names


def check_units(configuration: Configuration) -> Iterator[Problem]:
    """Yield connectors between variables of different units.

    Their ports go with every unit, so nothing else would notice.
    """
    for task in configuration.tasks:
        for name, joined in _joined(configuration, task):
            (_, first), *others = joined.values()
            unlike = [unit for _, unit in others if not same_unit(unit, first)]
            if not unlike:
                continue
            factor = conversion(unlike[0], first)
            yield Problem(
                code=Code.UNIT,
                what=f"{name} joins variables of different units",
                where=task.place("INVAR"),
                expected=f"one unit for {', '.join(joined)}",
                got=", ".join(f"{p}={v} in {unit}" for p, (v, unit) in joined.items()),
                remedy=(f"{factor}; " if factor else "")
                + "correct UNITS, or insert a gain that converts",
                tasks=(task.name,),
                ports=tuple(joined),
                variables=tuple(variable for variable, _ in joined.values()),
            )


_Joined = dict[str, tuple[str, str]]
"""By port: its variable and unit; without those of unknown unit."""


def _joined(configuration: Configuration, task: Task) -> Iterator[tuple[str, _Joined]]:
    """Yield every connector that a task is or has as a part, and what it joins."""
    ports = {port.name for port in task.info.ports} if task.info else set[str]()
    if task.rmod.module in CONNECTORS:
        ports = {"Z1", "Z2", "Z"}
    behind = {port: task.rmod.svar_name(port) for port in ports}
    units = {
        port: known.units
        for port, variable in behind.items()
        if (known := configuration.table.get(variable)) and known.units != ANY
    }
    if task.rmod.module in CONNECTORS:
        yield from _joined_here(
            task.name, behind, {behind[port]: units[port] for port in units}
        )
    elif task.info:
        yield from _within(task.name, task.info, units)


def _within(
    path: str, info: ModuleInfo, outer: Mapping[str, str]
) -> Iterator[tuple[str, _Joined]]:
    """Yield the connectors among the parts; `outer` has the units of its ports."""
    units = {
        one.variables[port.name]: port.unit
        for one in info.parts
        for port in one.info.ports
        if not port.kind.is_input and port.unit != ANY
    } | dict(outer)
    for one in info.parts:
        name = f"{path}.{one.name}"
        if one.info.name in CONNECTORS:
            yield from _joined_here(name, one.variables, units)
        else:
            ports = {p: units[v] for p, v in one.variables.items() if v in units}
            yield from _within(name, one.info, ports)


def _joined_here(
    name: str, behind: Mapping[str, str], units: Mapping[str, str]
) -> Iterator[tuple[str, _Joined]]:
    joined = {
        port: (behind[port], units[behind[port]])
        for port in ("Z1", "Z2", "Z")
        if behind[port] in units
    }
    if joined:
        yield name, joined
