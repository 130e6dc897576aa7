"""Layout of a table and of a task's local table: pure arithmetic.

A variable takes whole words of 8 bytes. In a group the variables are in the order of
their indices, in the table and in the local table alike, so that adjacent ones are
copied together.
"""

from __future__ import annotations

import hashlib
import itertools
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from pbonet.config import Variable
from pbonet.errors import SvarLayoutError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

_VARIABLES: Final = msgspec.msgpack.Decoder(tuple[Variable, ...])

WORD = 8
LINE = 64
NAME_LENGTH = 15
"""Maximum length of a variable's name in characters (Stewart 1994, section 5.5.2)."""


class Group(NamedTuple):
    """Variables that are written together, in the order of their indices."""

    indices: tuple[int, ...]
    at: tuple[int, ...]
    """Their places in the group."""
    bytes: int


def padded(size: int, unit: int = WORD) -> int:
    """Return `size` rounded up to whole units."""
    return -(-size // unit) * unit


def var_bytes(variable: Variable) -> int:
    """Return the size of the variable in a group, in bytes."""
    return padded(variable.itemsize * variable.nelem)


def values_of(
    variable: Variable, values: Sequence[float] | None, *, where: str
) -> NDArray[Any]:
    """Return `values` in the variable's type, padded with zeros.

    Raises:
        SvarLayoutError: There are too many, or a value does not fit the type.
    """
    import numpy as np  # not in a recorder, which asks for sizes only

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
            remedy="correct it, or NELEM and TYPE, in the .svar file",
        )
    lossy = "a value that the type cannot hold exactly"
    try:
        filled[: len(values)] = values
        fits = dtype.kind not in "biu" or np.array_equal(filled[: len(values)], values)
    except (ValueError, OverflowError, TypeError) as error:
        fits, lossy = False, str(error)
    if not fits:
        raise SvarLayoutError(
            f"{where} of {variable.name} does not fit",
            expected=f"values of type {variable.type}",
            got=lossy,
            remedy="correct it, or NELEM and TYPE, in the .svar file",
        )
    return filled


def check_variables(variables: Sequence[Variable]) -> None:
    """Refuse variables that cannot form a table.

    Raises:
        SvarLayoutError: A name is empty, too long or repeated, or NELEM is below 1.
    """
    seen: set[str] = set()
    for variable in variables:
        if not 0 < len(variable.name) <= NAME_LENGTH:
            raise SvarLayoutError(
                f"the name {variable.name!r} is of the wrong length",
                expected=f"1 to {NAME_LENGTH} characters",
                got=f"{len(variable.name)}",
                remedy="rename it in the .svar file",
            )
        if variable.name in seen:
            raise SvarLayoutError(
                f"the variable {variable.name} is defined twice",
                remedy="rename one of them in the .svar file",
            )
        if variable.nelem < 1:
            raise SvarLayoutError(
                f"the variable {variable.name} has no elements",
                expected="NELEM of at least 1",
                got=f"{variable.nelem}",
                remedy="correct NELEM in the .svar file",
            )
        seen.add(variable.name)


def encode(variables: Sequence[Variable]) -> bytes:
    """Return the variables in the format of the table's file."""
    plain = [msgspec.structs.replace(variable, place=None) for variable in variables]
    return msgspec.msgpack.encode(plain)


def decode(text: bytes) -> tuple[Variable, ...]:
    """Return the variables stored in a table's file."""
    return _VARIABLES.decode(text)


def layout_hash(variables: Sequence[Variable]) -> bytes:
    """Return 16 bytes that are equal for compatible tables.

    DESC is not included: it may be corrected while a subsystem runs.
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
    """Return the keeper's first group: INIT of every variable, zeros elsewhere."""
    import numpy as np

    sizes = [var_bytes(variable) for variable in variables]
    group = np.zeros(max(1, sum(sizes)), np.uint8)
    at = 0
    for variable, size in zip(variables, sizes, strict=True):
        values = values_of(variable, variable.init, where="INIT")
        group[at : at + values.nbytes] = values.view(np.uint8)
        at += size
    return group


def group_of(variables: Sequence[Variable], indices: Iterable[int]) -> Group:
    """Return the group of the variables with these indices."""
    chosen = tuple(sorted(indices))
    sizes = [var_bytes(variables[i]) for i in chosen]
    *places, size = itertools.accumulate(sizes, initial=0)
    return Group(chosen, tuple(places), size)
