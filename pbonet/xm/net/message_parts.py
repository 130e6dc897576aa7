"""Parts of messages: parameters, variables, the current job."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from msgspec import Struct

if TYPE_CHECKING:
    from numpy.typing import NDArray

Restart: TypeAlias = Literal["never", "off", "on"]
"""Treatment of a task whose RTPU process or machine was lost."""


def plain(value: NDArray[Any]) -> list[float] | bytes:
    """Return a variable's elements as sent in messages; ``bool`` becomes 0 and 1."""
    if value.dtype.kind == "V":
        return value.tobytes()
    numbers: list[float] = (value + 0 if value.dtype.kind == "b" else value).tolist()
    return numbers


class ParamValue(Struct, kw_only=True):
    """One parameter of a module."""

    name: str
    value: Any
    type: str
    unit: str
    doc: str
    bounds: str = ""


class VarValue(Struct, kw_only=True):
    """One variable of the table, with its provenance."""

    name: str
    index: int
    values: list[float] | bytes
    units: str
    desc: str = ""
    writer: str | None = None
    age: float | None = None
    """Seconds since it was written; None if it never was."""
    cycle: int = 0
    seq: int = 0
    stale: bool = False
    whole: bool = True
    """All values of the answer were current at one instant; False: not proven."""


class Standing(Struct, kw_only=True):
    """The job that was last started or switched to (section 3.2)."""

    name: str
    file: str
    post: list[tuple[str, int, int]] = []
    """Its POST conditions, each with line and column."""
