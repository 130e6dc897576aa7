"""What stands where in a table, and in a task's local table: pure arithmetic.

A variable takes whole words of 8 bytes. In a group the variables stand in the order of
their indices, in the table and in the local table alike, so that neighbours are copied
together.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from pbonet.config.model import Limit, Variable
from pbonet.errors import SvarLayoutError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

WORD = 8
LINE = 64
NAME_LENGTH = 15
"""Characters that a variable's name may have (Stewart 1994, section 5.5.2)."""

_TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")
_FINITE, _CLIP, _LIMIT = range(3)


class Check(NamedTuple):
    """One look at a stretch of a group before it is committed; guard.h reads it."""

    type: int
    rule: int
    var: int
    at: int
    n: int
    low: NDArray[np.uint8] | None
    high: NDArray[np.uint8] | None


class Group(NamedTuple):
    """Variables that are written together, and their places in the group."""

    vars: NDArray[np.uint32]
    at: NDArray[np.uint64]
    bytes: int


def padded(size: int, unit: int = WORD) -> int:
    """Return `size` rounded up to whole units."""
    return -(-size // unit) * unit


def var_bytes(variable: Variable) -> int:
    """Return the bytes that the variable takes in a group."""
    return padded(np.dtype(variable.dtype).itemsize * variable.nelem)


def values_of(
    variable: Variable, values: Sequence[float] | None, *, where: str
) -> NDArray[np.generic]:
    """Return `values` in the variable's type, filled up with zeros.

    Raises:
        SvarLayoutError: There are too many, or one of them does not fit the type.
    """
    dtype = np.dtype(variable.dtype)
    filled = np.zeros(variable.nelem, dtype)
    if values is None:
        return filled
    if dtype.kind == "V" or len(values) > variable.nelem:
        raise SvarLayoutError(
            f"{where} of {variable.name} does not fit",
            expected="none for a struct"
            if dtype.kind == "V"
            else f"at most {variable.nelem} values",
            got=f"{len(values)} values",
        )
    try:
        filled[: len(values)] = values
    except (ValueError, OverflowError) as error:
        raise SvarLayoutError(
            f"{where} of {variable.name} does not fit",
            expected=f"values of type {variable.type}",
            got=str(error),
        ) from None
    return filled


def check_variables(variables: Sequence[Variable]) -> None:
    """Refuse what cannot be a table.

    Raises:
        SvarLayoutError: A name is empty, too long or there twice, or NELEM is not positive.
    """
    seen: set[str] = set()
    for variable in variables:
        if not 0 < len(variable.name) <= NAME_LENGTH:
            raise SvarLayoutError(
                f"the name {variable.name!r} is of the wrong length",
                expected=f"1 to {NAME_LENGTH} characters",
                got=f"{len(variable.name)}",
            )
        if variable.name in seen:
            raise SvarLayoutError(f"the variable {variable.name} is there twice")
        if variable.nelem < 1:
            raise SvarLayoutError(
                f"the variable {variable.name} has no elements",
                expected="NELEM of at least 1",
                got=f"{variable.nelem}",
            )
        seen.add(variable.name)


def encode(variables: Sequence[Variable]) -> bytes:
    """Return the variables as the table's file carries them."""
    plain = [msgspec.structs.replace(variable, place=None) for variable in variables]
    return msgspec.msgpack.encode(plain)


def decode(text: bytes) -> tuple[Variable, ...]:
    """Return the variables out of a table's file."""
    return msgspec.msgpack.decode(text, type=tuple[Variable, ...])


def layout_hash(variables: Sequence[Variable]) -> bytes:
    """Return 16 bytes that are equal for tables that mean the same.

    DESC is left out: it may be corrected while a subsystem runs.
    """
    digest = hashlib.sha256()
    for v in variables:
        fields = (v.name, v.dtype, v.nelem, v.units, v.maxage, v.limit.value, v.finite)
        digest.update(repr(fields).encode())
        for part, values in (("INIT", v.init), ("MIN", v.min), ("MAX", v.max)):
            given = part.encode() if values is not None or part == "INIT" else b"-"
            digest.update(given)
            digest.update(values_of(v, values, where=part).tobytes())
    return digest.digest()[:16]


def initial_values(variables: Sequence[Variable]) -> NDArray[np.uint8]:
    """Return the keeper's first group: INIT of every variable, the rest zero."""
    sizes = [var_bytes(variable) for variable in variables]
    group = np.zeros(max(1, sum(sizes)), np.uint8)
    at = 0
    for variable, size in zip(variables, sizes, strict=True):
        values = values_of(variable, variable.init, where="INIT")
        group[at : at + values.nbytes] = values.view(np.uint8)
        at += size
    return group


def group_of(variables: Sequence[Variable], indices: Iterable[int]) -> Group:
    """Return the group of the variables with these indices, in their order."""
    chosen = sorted(indices)
    sizes = [var_bytes(variables[i]) for i in chosen]
    places = np.cumsum([0, *sizes])
    return Group(
        np.array(chosen, np.uint32), places[:-1].astype(np.uint64), int(places[-1])
    )


def checks_of(variables: Sequence[Variable], group: Group) -> list[Check]:
    """Return what is looked at before the group goes out.

    First whether floats are finite, so that an infinity is an error even where a limit
    would clip it; neighbours of one type are looked at in one go.
    """
    finite: list[Check] = []
    limits: list[Check] = []
    for index, at in zip(group.vars.tolist(), group.at.tolist(), strict=True):
        variable = variables[index]
        dtype = np.dtype(variable.dtype)
        if dtype.kind not in "iuf":
            continue
        code = _TYPES.index(f"{dtype.kind}{dtype.itemsize}")
        if dtype.kind == "f" and variable.finite:
            _add_finite(finite, Check(code, _FINITE, index, at, variable.nelem, None, None))
        if variable.limit is not Limit.NONE and variable.min and variable.max:
            rule = _CLIP if variable.limit is Limit.CLIP else _LIMIT
            low, high = (
                values_of(variable, values, where=where).view(np.uint8)
                for where, values in (("MIN", variable.min), ("MAX", variable.max))
            )
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


def blamed(variables: Sequence[Variable], index: int, element: int) -> tuple[str, int]:
    """Return name and element that a merged check means: it counts on over neighbours."""
    while element >= variables[index].nelem:
        element -= variables[index].nelem
        index += 1
    return variables[index].name, element
