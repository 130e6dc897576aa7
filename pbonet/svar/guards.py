"""Checks of a value before it enters the table: FINITE, LIMIT, MIN, MAX.

Tasks' commits are checked natively (guard.h) with the checks made here; values set by
an operator are checked here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from pbonet.config import Limit
from pbonet.errors import SvarError, SvarLayoutError

from .layout import elements, values_of

if TYPE_CHECKING:
    from array import array
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from pbonet.config import Variable

    from .layout import Group

_TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")
_FINITE, _CLIP, _LIMIT = range(3)


class Check(NamedTuple):
    """A check of a part of a group before it is committed; read by guard.h."""

    type: int
    rule: int
    var: int
    at: int
    n: int
    low: bytes | None
    high: bytes | None


def checks_of(variables: Sequence[Variable], group: Group) -> list[Check]:
    """Return the checks of a group before it is committed.

    First whether floats are finite, so that an infinity is an error even where a limit
    would clip it; adjacent variables of one type share one check.
    """
    finite: list[Check] = []
    limits: list[Check] = []
    for index, at in zip(group.indices, group.at, strict=True):
        variable = variables[index]
        kind = variable.dtype.lstrip("<")
        if kind not in _TYPES:
            continue
        code = _TYPES.index(kind)
        if _is_float(variable) and variable.finite:
            _add_finite(
                finite, Check(code, _FINITE, index, at, variable.nelem, None, None)
            )
        if variable.limit is not Limit.NONE and variable.min and variable.max:
            rule = _CLIP if variable.limit is Limit.CLIP else _LIMIT
            low, high = (limit.tobytes() for limit in limits_of(variable))
            limits.append(Check(code, rule, index, at, variable.nelem, low, high))
    return finite + sorted(limits, key=lambda check: -check.rule)


def _add_finite(checks: list[Check], new: Check) -> None:
    if checks:
        last = checks[-1]
        width = int(_TYPES[new.type][1])
        if last.type == new.type and last.at + last.n * width == new.at:
            checks[-1] = last._replace(n=last.n + new.n)
            return
    checks.append(new)


class Blamed(NamedTuple):
    """Details of a refused commit or a stale input."""

    variable: str = ""
    element: int = 0
    got: str = ""
    """The element's value."""
    expected: str = ""
    """Its limits, if any."""


def blame(variable: Variable, element: int, array: NDArray[Any]) -> Blamed:
    """Return the details of an element that was refused.

    Args:
        variable: The variable.
        element: Index from 0.
        array: The values that were to be written.
    """
    expected = ""
    if variable.limit is not Limit.NONE and variable.min and variable.max:
        low, high = (limit[element] for limit in limits_of(variable))
        units = "" if variable.units == "none" else f" {variable.units}"
        expected = f"{low} to {high}{units}"
    return Blamed(variable.name, element, str(array[element].item()), expected)


def blamed(
    variables: Sequence[Variable], groups: Iterable[Group], index: int, element: int
) -> tuple[Variable, int]:
    """Return the variable and element that a check refers to.

    A check of adjacent variables counts its elements through all of them.

    Args:
        variables: All variables of the table.
        groups: The groups that the task writes.
        index: The first variable of the check.
        element: The element that failed, counted from there.
    """
    order = next((g.indices for g in groups if index in g.indices), (index,))
    for one in order[order.index(index) :]:
        if element < variables[one].nelem:
            return variables[one], element
        element -= variables[one].nelem
    return variables[index], element


def limits_of(variable: Variable) -> tuple[array[Any], array[Any]]:
    """Return MIN and MAX in the variable's type; both must be given."""
    return (
        values_of(variable, variable.min, where="MIN"),
        values_of(variable, variable.max, where="MAX"),
    )


def typed(
    where: str, variable: Variable, values: Sequence[float] | bytes
) -> array[Any]:
    """Return an operator's values in the variable's type.

    Raises:
        SvarLayoutError: There are more or fewer values than elements, or they do not
            fit the type.
        SvarError: A value is not finite, or outside LIMIT.
    """
    raw = isinstance(values, bytes)
    expected = variable.itemsize * variable.nelem if raw else variable.nelem
    if len(values) != expected:
        unit = "bytes" if raw else "values"
        raise SvarLayoutError(
            f"the value does not fit {variable.name}",
            where=where,
            expected=f"{expected} {unit}",
            got=f"{len(values)} {unit}",
            remedy="give a value for each element",
        )
    if isinstance(values, bytes):
        result = elements(variable, values)
    else:
        result = values_of(variable, values, where="the value")
    _check_range(where, variable, result)
    return result


def _is_float(variable: Variable) -> bool:
    return "f" in variable.dtype


def _check_range(where: str, variable: Variable, values: array[Any]) -> None:
    if variable.finite and _is_float(variable) and not all(map(math.isfinite, values)):
        raise SvarError(
            f"{variable.name} takes finite values only",
            where=where,
            remedy="write FINITE no in the .svar file if NaN is intended",
        )
    if variable.limit is not Limit.NONE and variable.min and variable.max:
        low, high = limits_of(variable)
        parts = zip(values, low, high, strict=True)
        if any(value < least or value > most for value, least, most in parts):
            raise SvarError(
                f"{variable.name} would be outside its limits",
                where=where,
                expected=f"{low.tolist()} to {high.tolist()} {variable.units}",
                got=f"{values.tolist()}",
                remedy="give a value within them, or change them in the .svar file",
            )
