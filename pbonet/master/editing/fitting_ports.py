"""Ports and variables that a port can be connected to, and why others do not fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from msgspec import Struct

from pbonet.analysis.legality import constant_sizes, conversion, same_unit
from pbonet.config import Variable
from pbonet.errors import PortError
from pbonet.ports import Port, accepts, solve_shapes, wanted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pbonet.analysis.legality import Task

    from .draft_files import DraftFiles
    from .job_verdict import JobVerdict

ANY = "any"


class Fit(Struct, frozen=True, kw_only=True):
    """A port, or a variable alone, and whether another port can be connected to it."""

    task: str = ""
    port: str = ""
    """Empty: a variable that no port of the job uses."""
    variable: str
    fits: bool
    reason: str = ""
    """Why it does not fit."""


class _Side(NamedTuple):
    """A port of a task."""

    task: Task
    port: Port

    @property
    def variable(self) -> str:
        return self.task.rmod.svar_name(self.port.name)


class Fitting:
    """Finds what fits, in one state of a job.

    Args:
        files: The files.
        verdict: What is known about that state.
    """

    def __init__(self, files: DraftFiles, verdict: JobVerdict) -> None:
        self._sides = {
            task.name: [_Side(task, port) for port in task.info.ports]
            for task in verdict.tasks
            if task.info is not None
        }
        self.table = {one.name: one for one in files.draft.table.variables}
        now = verdict.configuration
        self.sizes: dict[str, int] = constant_sizes(now) if now else {}

    def side(self, task: str, port: str) -> _Side | None:
        """Return a port of a task; None: it is not known."""
        sides = self._sides.get(task, ())
        return next((side for side in sides if side.port.name == port), None)

    def of(self, task: str, port: str) -> list[Fit]:
        """Return all other ports, and variables without a port, for one port.

        Those that fit come first. Ports of the same direction, and of the same task,
        are left out.
        """
        one = self.side(task, port)
        if one is None:
            return []
        found = [
            _fit(other, self.misfit_of_ports(one, other))
            for name, sides in self._sides.items()
            for other in sides
            if name != task and other.port.kind.is_input is not one.port.kind.is_input
        ]
        used = {side.variable for sides in self._sides.values() for side in sides}
        for variable in self.table.values():
            if variable.name not in used:
                reason = self.misfit(one, variable)
                found.append(
                    Fit(variable=variable.name, fits=not reason, reason=reason)
                )
        return sorted(found, key=lambda fit: not fit.fits)

    def misfit_of_ports(self, one: _Side, other: _Side) -> str:
        """Return why an output and an input cannot be connected; empty: they can."""
        reader, writer = (one, other) if one.port.kind.is_input else (other, one)
        if reader.port.kind.is_const and not writer.port.kind.is_const:
            return f"{reader.port.name} is a constant, {writer.port.name} changes"
        variable = self.table.get(writer.variable)
        if variable is not None:
            return self.misfit(reader, variable)
        if not same_unit(reader.port.unit, writer.port.unit):
            return _units(reader.port.unit, writer.port.unit)
        if reader.port.type.removesuffix("[]") != writer.port.type.removesuffix("[]"):
            return f"types differ: {reader.port.type} and {writer.port.type}"
        return self._taken(reader, writer.variable)

    def misfit(self, side: _Side, variable: Variable) -> str:
        """Return why a port cannot be connected to a variable; empty: it can."""
        port = side.port
        if variable.units != ANY and not same_unit(port.unit, variable.units):
            return _units(port.unit, variable.units)
        if not accepts(port, variable.dtype):
            return (
                f"{port.name} takes {wanted(port)}, {variable.name} is {variable.type}"
            )
        return self._misfit_of_shape(side, variable) or self._taken(side, variable.name)

    def _taken(self, side: _Side, variable: str) -> str:
        """Return that another port of the task has the variable; empty: none has."""
        for other in self._sides[side.task.name]:
            if (
                other.port.name != side.port.name
                and other.port.kind.is_input is side.port.kind.is_input
                and other.variable == variable
            ):
                return f"{variable} is at {other.port.name} of the same task"
        return ""

    def _misfit_of_shape(self, side: _Side, variable: Variable) -> str:
        """Return why the number of elements does not fit; empty: it does."""
        info = side.task.info
        if info is None:
            return ""
        nelem: dict[str, int] = {}
        known: dict[str, int] = {}
        for port in info.ports:
            name = side.task.rmod.svar_name(port.name)
            if port.name != side.port.name and name in self.table:
                nelem[port.name] = self.table[name].nelem
            if port.is_size and name in self.sizes:
                known[port.name] = self.sizes[name]
        ports = (*info.ports, *info.within)
        if _clash(ports, nelem, known):
            return ""  # they are wrong without it, which is reported
        return _clash(ports, {**nelem, side.port.name: variable.nelem}, known)


def _fit(other: _Side, reason: str) -> Fit:
    return Fit(
        task=other.task.name,
        port=other.port.name,
        variable=other.variable,
        fits=not reason,
        reason=reason,
    )


def _units(one: str, other: str) -> str:
    factor = conversion(other, one)
    return f"units differ: {one} and {other}" + (f"; {factor}" if factor else "")


def _clash(
    ports: tuple[Port, ...], nelem: Mapping[str, int], known: Mapping[str, int]
) -> str:
    """Return what is wrong with the sizes of ports; nothing if one is not known yet."""
    try:
        solve_shapes(ports, nelem, known)
    except PortError as error:
        if error.got:
            sides = f"expected {error.expected}, got {error.got}"
            return f"sizes differ: {error.what} ({sides})"
    return ""
