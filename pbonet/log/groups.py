"""Values of variables as bytes, in the format of a table: each in whole words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pbonet.svar import padded, var_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from pbonet.config import Variable


def pack(variables: Iterable[Variable], array: Callable[[str], NDArray[Any]]) -> bytes:
    """Return the values of variables, one after the other.

    Args:
        variables: The variables, in the order of the table.
        array: Returns the array of a variable by its name.
    """
    parts: list[bytes] = []
    for variable in variables:
        data = array(variable.name).tobytes()
        parts += [data, bytes(padded(len(data)) - len(data))]
    return b"".join(parts)


def unpack(
    variables: Iterable[Variable],
    data: bytes | memoryview,
    array: Callable[[str], NDArray[Any]],
) -> None:
    """Copy values back to the arrays they came from."""
    at = 0
    for variable in variables:
        to = array(variable.name).view("u1")
        to[:] = memoryview(data)[at : at + to.size]
        at += var_bytes(variable)


def size(variables: Iterable[Variable]) -> int:
    """Return the size of the values in bytes."""
    return sum(var_bytes(variable) for variable in variables)
