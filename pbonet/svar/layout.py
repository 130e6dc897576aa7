"""Layout of a table and of a task's local table: pure arithmetic.

A variable takes whole words of 8 bytes. In a group the variables are in the order of
their indices, in the table and in the local table alike, so that adjacent ones are
copied together.
"""

from __future__ import annotations

import itertools
from array import array
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from pbonet.config import Variable
from pbonet.errors import SvarLayoutError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from _typeshed import ReadableBuffer

_VARIABLES: Final = msgspec.msgpack.Decoder(tuple[Variable, ...])

WORD = 8
LINE = 64
NAME_LENGTH = 15
"""Maximum length of a variable's name in characters (Stewart 1994, section 5.5.2)."""
_CODES: Final = {
    "b1": "B",
    "i1": "b",
    "u1": "B",
    "<i2": "h",
    "<u2": "H",
    "<i4": "i",
    "<u4": "I",
    "<i8": "q",
    "<u8": "Q",
    "<f4": "f",
    "<f8": "d",
}
"""Python's own arrays of each type but ``struct[xx]``, by numpy's type string."""


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
) -> array[Any]:
    """Return `values` in the variable's type, padded with zeros; bytes of a struct.

    It is no array of numpy, which agents do without.

    Raises:
        SvarLayoutError: There are too many, or a value does not fit the type.
    """
    filled = elements(variable, bytes(variable.itemsize * variable.nelem))
    if values is None:
        return filled
    is_struct = variable.dtype not in _CODES
    if is_struct or len(values) > variable.nelem:
        raise SvarLayoutError(
            f"{where} of {variable.name} does not fit",
            expected="none for a struct"
            if is_struct
            else f"at most {variable.nelem} values",
            got=f"{len(values)} values",
            remedy="correct it, or NELEM and TYPE, in the .svar file",
        )
    try:
        made = array(filled.typecode, _converted(variable, values))
    except (ValueError, OverflowError, TypeError) as error:
        raise _misfit(variable, where, str(error)) from None
    if filled.typecode not in "fd" and made.tolist() != list(values):
        lossy = "a value that the type cannot hold exactly"
        raise _misfit(variable, where, lossy)
    filled[: len(made)] = made
    return filled


def _misfit(variable: Variable, where: str, got: str) -> SvarLayoutError:
    return SvarLayoutError(
        f"{where} of {variable.name} does not fit",
        expected=f"values of type {variable.type}",
        got=got,
        remedy="correct it, or NELEM and TYPE, in the .svar file",
    )


def _converted(variable: Variable, values: Iterable[float]) -> Iterable[float]:
    if variable.dtype == "b1":
        return map(bool, values)
    return values if "f" in variable.dtype else map(int, values)


def elements(variable: Variable, data: ReadableBuffer) -> array[Any]:
    """Return a copy of a variable's elements; the bytes of a struct.

    Args:
        variable: The variable.
        data: Its bytes, as stored in a group; padding may follow.
    """
    size = variable.itemsize * variable.nelem
    made: array[Any] = array(_CODES.get(variable.dtype, "B"))
    made.frombytes(memoryview(data).cast("B")[:size])
    return made


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
    import hashlib  # brings OpenSSL; an agent makes no table

    digest = hashlib.sha256()
    for v in variables:
        fields = (v.name, v.dtype, v.nelem, v.units, v.maxage, v.limit.value, v.finite)
        digest.update(repr(fields).encode())
        for part, values in (("INIT", v.init), ("MIN", v.min), ("MAX", v.max)):
            given = part.encode() if values is not None or part == "INIT" else b"-"
            digest.update(given)
            digest.update(values_of(v, values, where=part).tobytes())
    return digest.digest()[:16]


def initial_values(variables: Sequence[Variable]) -> bytes:
    """Return the keeper's first group: INIT of every variable, zeros elsewhere."""
    group = b"".join(
        values_of(one, one.init, where="INIT").tobytes().ljust(var_bytes(one), b"\0")
        for one in variables
    )
    return group or bytes(1)


def group_of(variables: Sequence[Variable], indices: Iterable[int]) -> Group:
    """Return the group of the variables with these indices."""
    chosen = tuple(sorted(indices))
    sizes = [var_bytes(variables[i]) for i in chosen]
    *places, size = itertools.accumulate(sizes, initial=0)
    return Group(chosen, tuple(places), size)
