"""A log's description of a task, and the kinds of records that a task makes."""

from __future__ import annotations

import zlib
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec
from msgspec import Struct

from pbonet.config import Variable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from .time_conversion import Moves

T = TypeVar("T")

FORMAT = 2
"""The version of pbonet's log format: since 2 a message can have several cycles."""
SPAN_NS = 100_000_000
"""The most nanoseconds between the ends of the cycles in a message."""
METADATA = "pbonet"
"""Name of the metadata record that describes the run."""
CHECKSUM = "checksum"
"""Field of a metadata record with the CRC-32 of its name and other fields: MCAP itself
has none for it."""
CLOCKS = "pbonet clocks"
"""Name of the metadata record of a merged log that describes the time conversions."""
EPOCH = "epoch_ns"
"""Metadata of a task's channel in a merged log: the offset from its CLOCK_MONOTONIC, in
the format of `pbonet.log.time_conversion.Moves`."""
MACHINE = "machine"
"""Metadata of a task's channel in a log of several machines: its machine."""
RUN = "run"
"""Metadata of a task's channel in a log of several runs: its run."""
ATTACHED = "attached"
"""Metadata of each file of a merged log: current names of its attachments, by original
name, as JSON."""


def log_name(file: str, part: int) -> str:
    """Return the file name of a recording's first file, second file, and so on."""
    return f"{file}.mcap" if part == 1 else f"{file}-{part}.mcap"


class Step(IntEnum):
    """The subject of a record of a task's ring.

    Besides cycles these are the copies around the other methods, as made by the
    executor, and its reasons to run them: all that is needed to replay the module.
    """

    CYCLE = 0
    CONSTS_IN = 1
    """In-consts were copied in; the data are their values."""
    ON_IN = 2
    """In-vars and out-vars were copied in, before `on`; the data are the in-vars, then
    the out-vars."""
    VARS_IN = 3
    """In-vars were copied in outside a cycle."""
    CONSTS_OUT = 4
    """Out-consts were copied out."""
    CLAIM = 5
    """Out-vars were committed and owned, after `on`."""
    COMMIT = 6
    """Out-vars were committed outside a cycle, after `off`."""
    DID = 7
    """A signal, a new parameter or the like, as JSON text (`Did`)."""
    HEARD = 8
    """Inputs of a method from outside the table, before the copy that follows
    (`pbonet.outside`); a cycle's own record contains its inputs."""
    SYNC = 9
    """Inputs of ``sync``, which was called then; recorded before its cycle."""


class Did(Struct, omit_defaults=True):
    """A reason why the executor ran methods other than ``cycle``."""

    what: str
    """``spawn``, a signal, ``set``, ``freq``, ``abort``, ``fault`` or ``refused``."""
    arg: str = ""
    handover: bool = False
    """Whether a successor took over the outputs; for ``on``, whether this task did."""
    cede: bool = False
    """Whether it did so in its own claim, without an interval without an owner."""
    name: str = ""
    """Name of the parameter, for ``set``; of the failed method, for ``fault``."""
    hz: float = 0.0
    calls: list[int] = []
    """For ``abort``: how often each outside source had been asked by then."""


class Origin(NamedTuple):
    """The origin of a task in a log."""

    machine: str
    """Its boot identity."""
    run: str
    moves: Moves
    """Offset from its CLOCK_MONOTONIC to nanoseconds since 1970."""


class Table(NamedTuple):
    """The table that a task's commits went to; they are numbered in it."""

    machine: str
    run: str
    domain: str
    subsystem: str


class CodeFile(Struct, frozen=True):
    """A file with code of a module."""

    path: str
    sha256: str


class TaskAbout(Struct, kw_only=True):
    """The task whose cycles a ring or a channel holds."""

    domain: str
    rtpu: str
    subsystem: str
    task: str
    module: str
    pid: int
    freq: float
    rmod: str
    """Text of the RMOD it was spawned from."""
    rmod_name: str
    libraries: tuple[str, ...] = ()
    inconst: list[Variable] = []
    invar: list[Variable] = []
    outconst: list[Variable] = []
    outvar: list[Variable] = []
    code: list[CodeFile] = []
    """The module's own file first."""
    hidden: list[str] = []
    """Its variables that are not recorded: no columns, and zeros in copies."""
    hears: bool = False
    """Whether its inputs from outside the table are recorded."""
    timing: bool = False
    """Whether the calls of its handler of timing failures are recorded."""
    seed: int = 0
    """Where its random numbers begin."""
    tried: list[str] = []
    """Parameters that a replay used in place of those of the RMOD, with both values."""

    @property
    def topic(self) -> str:
        """The channel of its cycles."""
        return f"{self.subsystem}/{self.task}"


class RunAbout(Struct, kw_only=True):
    """The run to which a log belongs."""

    run: str
    job: str
    subsystem: str
    domain: str
    rtpu: str
    host: str = ""
    machine: str = ""
    """Boot identity; times of one boot can be compared."""
    pbonet: str = ""
    python: str = ""
    numpy: str = ""
    kernel: str = ""
    config_hash: str = ""
    """SHA-256 of the files attached at the start: `.job`, `.sbs`, `.svar`, the `.rmod`
    files of the job, `agent.toml`."""
    begun: str = ""
    """Date and time, for display."""
    epoch_ns: int = 0
    """Offset from CLOCK_MONOTONIC to the times of messages, in nanoseconds."""
    part: int = 1
    """2, 3, ... after a recorder was lost or a file was full."""
    goes_on: bool = False
    """Whether nothing is missing between the previous file and this one."""
    last: float = 0.0
    """Seconds before an error that were kept; 0: everything was to be recorded."""
    seconds: float = 0.0
    """Elapsed virtual time of a simulation; 0: the run was in real time."""
    format: int = FORMAT


class Attached(Struct, frozen=True):
    """A file attached to a log."""

    name: str
    data: bytes
    media_type: str = "text/plain"


def checksum_of(name: str, fields: Mapping[str, str]) -> str:
    """Return the checksum of a metadata record."""
    return f"{zlib.crc32(msgspec.json.encode([name, sorted(fields.items())])):08x}"


def checked(name: str, fields: Mapping[str, str]) -> dict[str, str]:
    """Return the fields of a metadata record with their checksum."""
    return {**fields, CHECKSUM: checksum_of(name, fields)}


def is_ours(name: str) -> bool:
    """Return whether a metadata record describes the run of a file."""
    first, _, rest = name.partition(" ")
    return first == METADATA and (not rest or rest.isdecimal())


def free_name(name: str, content: T, taken: Mapping[str, T]) -> str:
    """Return a free name for a file: ``a.rmod``, or ``a-2.rmod`` if that is taken.

    A name in `taken` is returned if its content is the same.
    """
    stem, dot, suffix = name.rpartition(".")
    first, number = name, 1
    while taken.get(name, content) != content:
        number += 1
        name = f"{stem}-{number}.{suffix}" if dot else f"{first}-{number}"
    return name


JsonObject = dict[str, Any]
