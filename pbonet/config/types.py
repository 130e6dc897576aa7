"""The types of a state variable: the thesis's own and fixed widths beside them.

The names of section 5.5.2 keep the sizes they had on the thesis's machines (``int`` is
32 bits, ``char`` is signed), so that a table means the same on every machine.
"""

from __future__ import annotations

import re
from functools import cache
from typing import NamedTuple

MAX_STRUCT = 1 << 20
"""Largest size of ``struct[xx]`` in bytes."""

_STRUCT = re.compile(r"struct\[([1-9][0-9]{0,7})\]")


class ElementType(NamedTuple):
    """The type of one element of a variable.

    Attributes:
        name: As the file spells it.
        dtype: numpy's type string, little endian.
        size: Bytes.
        low: Smallest value; for floats the negative of the largest finite one.
        high: Largest value.
    """

    name: str
    dtype: str
    size: int
    low: float | int
    high: float | int

    @property
    def is_float(self) -> bool:
        """Whether values have a fraction."""
        return isinstance(self.high, float)

    @property
    def is_bool(self) -> bool:
        """Whether values are true and false."""
        return self.dtype == "b1"

    @property
    def is_struct(self) -> bool:
        """Whether the table knows nothing of the contents."""
        return self.dtype.startswith("V")

    @property
    def values(self) -> str:
        """The values in words, for messages."""
        if self.is_bool:
            return "0, 1, false or true"
        if self.is_float:
            return f"a number within +-{self.high:.4g}"
        return f"a whole number from {self.low} to {self.high}"


def _whole(name: str, dtype: str) -> ElementType:
    size = int(dtype[-1])
    bits = 8 * size
    if "u" in dtype:
        return ElementType(name, dtype, size, 0, 2**bits - 1)
    return ElementType(name, dtype, size, -(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def _fraction(name: str, dtype: str, largest: float) -> ElementType:
    return ElementType(name, dtype, int(dtype[-1]), -largest, largest)


_FLOAT32_MAX = 3.4028234663852886e38
_FLOAT64_MAX = 1.7976931348623157e308

TYPES: dict[str, ElementType] = {
    kind.name: kind
    for kind in (
        _whole("byte", "u1"),
        _whole("char", "i1"),
        _whole("word", "<u2"),
        _whole("short", "<i2"),
        _whole("unsigned", "<u4"),
        _whole("int", "<i4"),
        _fraction("float", "<f4", _FLOAT32_MAX),
        _fraction("double", "<f8", _FLOAT64_MAX),
        _whole("int8", "i1"),
        _whole("uint8", "u1"),
        _whole("int16", "<i2"),
        _whole("uint16", "<u2"),
        _whole("int32", "<i4"),
        _whole("uint32", "<u4"),
        _whole("int64", "<i8"),
        _whole("uint64", "<u8"),
        _fraction("float32", "<f4", _FLOAT32_MAX),
        _fraction("float64", "<f8", _FLOAT64_MAX),
        ElementType("bool", "b1", 1, 0, 1),
    )
}
"""Every type but ``struct[xx]``, by name."""


def element_type(name: str) -> ElementType | None:
    """Return the type that a file calls `name`, None for an unknown one."""
    if match := _STRUCT.fullmatch(name):
        size = int(match[1])
        if size > MAX_STRUCT:
            return None
        return ElementType(name, f"V{size}", size, 0, 0)
    return TYPES.get(name)


@cache
def _known(name: str) -> ElementType:
    kind = element_type(name)
    if kind is None:
        msg = f"{name!r} is not a type of a state variable"
        raise ValueError(msg)
    return kind


def numpy_type(name: str) -> str:
    """Return numpy's type string of `name`, such as ``<f8`` or ``V32``.

    Raises:
        ValueError: There is no such type.
    """
    return _known(name).dtype


def item_bytes(name: str) -> int:
    """Return the bytes of one element of the type that a file calls `name`.

    Raises:
        ValueError: There is no such type.
    """
    return _known(name).size
