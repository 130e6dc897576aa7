"""Records that describe the table."""

from __future__ import annotations

from msgspec import Struct


class VarInfo(Struct, frozen=True):
    """Provenance of a variable's value."""

    owner: str | None
    """The task that writes it now; None: no task."""
    writer: str | None
    """The task that wrote the current value; None: INIT, or an operator."""
    time_ns: int
    """When it was committed, or the older time of the data from which it was computed,
    CLOCK_MONOTONIC nanoseconds; 0 if never."""
    age_ns: int | None
    """Nanoseconds since then; None if it was never written."""
    cycle: int
    """The writer's cycle; for values set by an operator, how often that was done."""
    seq: int
    """Number of the commit in its register."""
    register: int
    """The register's uid, unique for the life of the table."""
    stale: bool
    """Whether it is older than MAXAGE."""


class Register(Struct, frozen=True):
    """One register and its holder."""

    index: int
    uid: int
    owner: int
    """Equal for the registers of one task; for `Table.reap`."""
    pid: int
    task: str
    bytes: int
    commits: int
    held: bool
    """False: the holder has released it, but its values may still be current."""


class Cause(Struct, frozen=True):
    """One reason why the illegal-configuration flag is up."""

    cause: str
    raiser: str
    machine: str
    time_ns: int


class Counts(Struct, frozen=True, kw_only=True):
    """Totals of a local table since it was made."""

    copies: int
    retries: int
    torn: int
    """Copies that reached the retry limit."""
    lost: int
    stale: int
    commits: int
    refused: int
    """Commits that a guard refused."""
    clipped: int
    """Elements that LIMIT clip has changed."""
