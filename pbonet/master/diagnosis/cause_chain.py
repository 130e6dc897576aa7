"""A chain of causes, as a record and as text."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterator


class Source(StrEnum):
    """Where a fact of a chain was read."""

    STATUS = "status"
    EVENTS = "events"
    TABLE = "table"
    FILES = "files"
    SCHEDULE = "schedule"
    AGENTS = "agents"
    LOG = "log"
    KERNEL = "kernel"


class Cause(Struct, frozen=True, kw_only=True):
    """A cause, with its own causes."""

    what: str
    source: Source
    because: tuple[Cause, ...] = ()
    remedy: str = ""
    """The remedy; empty where one of its own causes says so."""


class Explanation(Struct, frozen=True, kw_only=True):
    """The answer to a question."""

    kind: str
    """``flag``, ``task``, ``variable``, ``rtpu``, ``start`` or ``miss``."""
    name: str
    """The subject; empty for the flag and the present job."""
    what: str
    """How it is now."""
    causes: tuple[Cause, ...] = ()
    healthy: tuple[str, ...] = ()
    """Since when it is well, and its figures; empty: that is not known of it."""
    unknown: tuple[str, ...] = ()
    """Parts that could not be read, so that causes there are not seen."""

    @property
    def found(self) -> bool:
        """Whether a cause was found."""
        return bool(self.causes)

    @property
    def answered(self) -> bool:
        """Whether a cause was found, or there is none because it is well."""
        return self.found or bool(self.healthy)

    def __str__(self) -> str:
        """Return it as lines; a cause stands below what it explains."""
        lines = [self.what]
        for cause in self.causes:
            lines += _lines(cause, 1)
        lines += [f"  {line}" for line in self.healthy]
        if not self.answered:
            lines.append("no cause was found")
        lines += [f"not read: {one}" for one in self.unknown]
        return "\n".join(lines)


def _lines(cause: Cause, depth: int) -> Iterator[str]:
    indent = "  " * depth
    first, *rest = cause.what.splitlines() or [""]
    yield f"{indent}because {first} [{cause.source}]"
    yield from (f"{indent}  {line}" for line in rest)
    for behind in cause.because:
        yield from _lines(behind, depth + 1)
    if cause.remedy:
        yield f"{indent}  do: {cause.remedy}"
