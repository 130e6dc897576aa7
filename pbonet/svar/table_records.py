"""Records with which the table describes itself."""

from __future__ import annotations

from msgspec import Struct


class VarInfo(Struct, frozen=True):
    """Where the value of a variable comes from."""

    owner: str | None
    """The task that writes it now; None: nobody does."""
    writer: str | None
    """The task that wrote the present value; None: INIT, or an operator."""
    time_ns: int
    """When it was committed, CLOCK_MONOTONIC; 0 when it never was."""
    age_ns: int | None
    """How long ago that was; None when it never was written."""
    cycle: int
    """The writer's cycle; for values an operator set, how often that was done."""
    seq: int
    """Number of the commit in its register."""
    register: int
    """The register's uid, unique for the life of the table."""
    stale: bool
    """True when older than MAXAGE."""


class Register(Struct, frozen=True):
    """One register and its holder."""

    index: int
    uid: int
    owner: int
    """Equal for the registers of one task; what `Table.reap` takes."""
    pid: int
    task: str
    bytes: int
    commits: int
    held: bool
    """False: the holder has gone, values of it may still stand."""


class Cause(Struct, frozen=True):
    """One reason for which the illegal-configuration flag is up."""

    cause: str
    raiser: str
    machine: str
    time_ns: int


class Counts(Struct, frozen=True, kw_only=True):
    """Totals of a local table since it was made."""

    copies: int
    retries: int
    torn: int
    """Copies that met the retry bound."""
    lost: int
    stale: int
    commits: int
    refused: int
    """Commits that a guard refused."""
    clipped: int
    """Elements that LIMIT clip brought inside."""
