"""A log's description of a task, and the kinds of records that a task makes."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from msgspec import Struct

from pbonet.config import Variable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from .moves import Moves

T = TypeVar("T")

FORMAT = 1
"""The version of what pbonet writes into its logs."""
METADATA = "pbonet"
"""The name of the metadata record that says which run this is."""
CLOCKS = "pbonet clocks"
"""That of the one that says, in a merged log, what times were brought together by."""
EPOCH = "epoch_ns"
"""Of a task's channel in a merged log: what is added to its CLOCK_MONOTONIC, as
`pbonet.log.moves.Moves` has it."""
MACHINE = "machine"
"""Of a task's channel in a log of several machines: that on which it ran."""
RUN = "run"
"""Of a task's channel in a log of several runs: that in which it ran."""
ATTACHED = "attached"
"""In what a merged log says of one of its files: names of attachments, by that file's
own, as JSON."""


class Step(IntEnum):
    """The subject of a record of a task's ring.

    Behind cycles come the copies around the other methods, as the executor made them,
    and what made it run them; all that is needed to run the module's code again.
    """

    CYCLE = 0
    CONSTS_IN = 1
    """In-consts were copied in; the data are those."""
    ON_IN = 2
    """In-vars and out-vars were copied in, before `on`; the data are the in-vars, then
    the out-vars."""
    VARS_IN = 3
    """In-vars were copied in outside a cycle."""
    CONSTS_OUT = 4
    """Out-consts were copied out."""
    CLAIM = 5
    """Out-vars were committed and owned, behind `on`."""
    COMMIT = 6
    """Out-vars were committed outside a cycle, behind `off`."""
    DID = 7
    """A signal, a new parameter or the like, as JSON text (`Did`)."""
    HEARD = 8
    """Inputs of a method from outside the table, before the copy that follows
    (`pbonet.outside`); cycles have it in their own records."""
    SYNC = 9
    """Inputs of ``sync``, which was called then; recorded before its cycle."""


class Did(Struct, omit_defaults=True):
    """Events that made the executor run methods other than ``cycle``."""

    what: str
    """``spawn``, a signal, ``set``, ``freq``, ``abort``, ``fault`` or ``refused``."""
    arg: str = ""
    handover: bool = False
    """A successor took over the outputs."""
    cede: bool = False
    """It did so in its own claim: they were given up to nobody else."""
    name: str = ""
    """Of the parameter, for ``set``; of the method that failed, for ``fault``."""
    hz: float = 0.0
    calls: list[int] = []
    """For ``abort``: how often each source outside was asked by then."""


class Origin(NamedTuple):
    """Where a task of a log came from."""

    machine: str
    """By boot identity."""
    run: str
    moves: Moves
    """Offset from its CLOCK_MONOTONIC to nanoseconds since 1970."""


class Table(NamedTuple):
    """The table that a task's commits went to: they are numbered there."""

    machine: str
    run: str
    domain: str
    subsystem: str


class CodeFile(Struct, frozen=True):
    """A file whose code a module runs."""

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
    """Its variables that are not recorded: no columns, and 0 in what is copied."""
    hears: bool = False
    """Its inputs from outside the table are recorded."""
    timing: bool = False
    """So is what its handler of timing failures was told, and answered."""

    @property
    def topic(self) -> str:
        """The channel of its cycles."""
        return f"{self.subsystem}/{self.task}"


class RunAbout(Struct, kw_only=True):
    """Which run a log is of."""

    run: str
    job: str
    subsystem: str
    domain: str
    rtpu: str
    host: str = ""
    machine: str = ""
    """Boot identity: clocks of one machine may be compared."""
    pbonet: str = ""
    python: str = ""
    numpy: str = ""
    kernel: str = ""
    config_hash: str = ""
    """SHA-256 over what the log carried when it began: `.job`, `.sbs`, `.svar`, the
    `.rmod` files of the job, `agent.toml`."""
    begun: str = ""
    """Date and time, for people to read."""
    epoch_ns: int = 0
    """Offset from CLOCK_MONOTONIC to the times of messages."""
    part: int = 1
    """2, 3, ... after a recorder was lost or a file was full."""
    goes_on: bool = False
    """Nothing is missing between the file before it and this one."""
    seconds: float = 0.0
    """Virtual time that passed, in a simulation; 0: the run was in real time."""
    format: int = FORMAT


class Attached(Struct, frozen=True):
    """A file that a log carries."""

    name: str
    data: bytes
    media_type: str = "text/plain"


def free_name(name: str, content: T, taken: Mapping[str, T]) -> str:
    """Return the name for a file: ``a.rmod``, or ``a-2.rmod`` where it is another one.

    A name that is in `taken` is of the same content.
    """
    stem, dot, suffix = name.rpartition(".")
    first, number = name, 1
    while taken.get(name, content) != content:
        number += 1
        name = f"{stem}-{number}.{suffix}" if dot else f"{first}-{number}"
    return name


JsonObject = dict[str, Any]
