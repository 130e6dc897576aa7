"""Parts of messages: parameters, variables, the current job."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

from msgspec import Struct

Restart: TypeAlias = Literal["never", "off", "on"]
"""Treatment of a task whose RTPU process or machine was lost."""


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
