"""Unsafe parts of a configuration: data of any age, robots that nothing stops.

An input that comes from another machine or over a link stands still when its writer is
lost, and looks as it did. A robot interface turns what it reads into motion. Both are
warnings, and with ``STRICT yes`` in the ``.sbs`` file they are refused. An input that
no task writes is refused in any case (equation 2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.ports import Kind

from .freshness import max_age
from .records import Code, Problem, Severity

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.ports import Port

    from .records import Configuration, Task

RECEIVERS = frozenset({"tbuf_receive", "mav_ground", "mav_vehicle"})
"""Modules of the library that write what comes over a link."""


def check_safety(configuration: Configuration) -> Iterator[Problem]:
    """Yield the inputs of running tasks without a limit of age, and unsafe robots."""
    severity = Severity.REFUSE if configuration.strict else Severity.WARN
    for task in configuration.running:
        yield from _old_inputs(configuration, task, severity)
        yield from _robot(task, severity)
        yield from _restart(task)


def _old_inputs(
    configuration: Configuration, task: Task, severity: Severity
) -> Iterator[Problem]:
    ports = task.info.ports if task.info else ()
    for port in ports:
        if port.kind is not Kind.INVAR:
            continue
        variable = task.rmod.svar_name(port.name)
        limit = max_age(port, configuration.table.get(variable))
        way = _way(configuration, task, variable)
        if way and limit is None:
            yield _without_limit(task, port, variable, way, severity)


def _way(configuration: Configuration, task: Task, variable: str) -> str:
    """Return how a variable comes here from elsewhere; empty if it does not."""
    for writer in configuration.writers.get(variable, ()):
        if not RECEIVERS.isdisjoint(writer.rmod.module.split("+")):
            return f"over the link that {writer.name} receives"
        machines = configuration.machines
        here, there = machines.get(task.rtpu), machines.get(writer.rtpu)
        if here and there and here != there:
            return f"from {writer.name} on another machine ({writer.rtpu})"
    return ""


def _without_limit(
    task: Task, port: Port, variable: str, way: str, severity: Severity
) -> Problem:
    return Problem(
        code=Code.NO_LIMIT,
        severity=severity,
        what=f"{task.name} reads {variable}, which comes {way}, whatever its age",
        where=task.place("INVAR"),
        expected="a limit of its age: when the other side is lost the last value stays",
        remedy=f"write MAXAGE and seconds under NAME {variable} in the .svar file, or "
        f"max_age=... at the port {port.name} of {task.rmod.module}",
        tasks=(task.name,),
        ports=(port.name,),
        variables=(variable,),
    )


def _robot(task: Task, severity: Severity) -> Iterator[Problem]:
    if task.info is None or not task.info.robot_interface:
        return
    name, module = task.rmod.name, task.rmod.module
    if not task.info.critical_ok:
        what = (
            f", and its module {module} does not say what to do when the "
            "configuration is illegal"
        )
        expected = "stable(), or a safe value of each out-var"
        remedy = f"write stable(self, dt) in {module}, and CRITICAL in {name}.rmod"
    elif not task.rmod.critical:
        what = " and not CRITICAL, so it acts while the configuration is illegal"
        expected, remedy = "CRITICAL", f"write CRITICAL in {name}.rmod"
    else:
        return
    yield Problem(
        code=Code.UNSAFE_ROBOT,
        severity=severity,
        what=f"{task.name} is a robot interface{_guess(task)}{what}",
        where=task.place("MODULE"),
        expected=expected,
        remedy=f"{remedy}{_or_class(task)}",
        tasks=(task.name,),
    )


def _guess(task: Task) -> str:
    """Return why a task counts as a robot interface that does not say so itself."""
    if task.info is None or task.info.module_class or task.info.parts:
        return ""
    return " (it reads variables, uses an output device of pbonet.io, and has no class)"


def _or_class(task: Task) -> str:
    if not _guess(task):
        return ""
    return f', or module_class="..." in {task.rmod.module} if it moves nothing'


def _restart(task: Task) -> Iterator[Problem]:
    if task.restart != "on" or task.info is None or not task.info.robot_interface:
        return
    yield Problem(
        code=Code.RESTART,
        severity=Severity.WARN,
        what=f"{task.name} has RESTART on and is a robot interface{_guess(task)}, "
        "which never comes ON unasked: it is spawned again and stays OFF",
        where=task.place("RESTART"),
        remedy=f"write RESTART off, and turn it on by hand{_or_class(task)}",
        tasks=(task.name,),
    )
