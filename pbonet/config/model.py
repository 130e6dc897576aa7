"""Configuration files as typed records (Stewart 1994, 3.8, 4.3, 5.5.2).

The readers in this package make these records from text and the writer makes text from
them; nothing else in pbonet reads the text. Places are kept where a later step may
still find a fault, so that it can name file, line and column.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Literal, TypeAlias

from msgspec import Struct

from .device import Entry
from .spp import SppEntry
from .types import item_bytes, numpy_type

Restart: TypeAlias = Literal["never", "off", "on"]
"""Treatment of a task whose RTPU process or machine was lost."""


class Place(Struct, frozen=True, order=True):
    """A place in a file: its name, line and column, both from 1."""

    file: str
    line: int
    column: int = 1

    def __str__(self) -> str:
        """Return ``file:line:column``."""
        return f"{self.file}:{self.line}:{self.column}"


class Limit(StrEnum):
    """Treatment of a value outside MIN and MAX when it is written."""

    NONE = "none"
    CLIP = "clip"
    ERROR = "error"


class Variable(Struct, frozen=True, kw_only=True):
    """One variable of a state variable table (section 5.5.2)."""

    name: str
    """At most 15 characters, as in the thesis."""
    type: str
    """As the file spells it: ``double``, ``int``, ``struct[32]``, ``float32`` ..."""
    desc: str = ""
    units: str = "none"
    nelem: int = 1
    init: tuple[float | int, ...] | None = None
    """May be shorter than `nelem`; the rest is zero."""
    min: tuple[float | int, ...] | None = None
    max: tuple[float | int, ...] | None = None
    maxage: float | None = None
    """Seconds; a reader sees the variable as stale when it is older."""
    rate: float | None = None
    """Hz; no more often is it carried to other machines. None: each commit is."""
    limit: Limit = Limit.NONE
    finite: bool = True
    """False admits NaN and infinities on copy-out."""
    place: Place | None = None

    @property
    def dtype(self) -> str:
        """The numpy type string of one element, such as ``<f8`` or ``V32``."""
        return numpy_type(self.type)

    @property
    def itemsize(self) -> int:
        """The bytes of one element."""
        return item_bytes(self.type)


class SvarFile(Struct, frozen=True, kw_only=True):
    """A ``.svar`` file: the union of all ports a subsystem may use."""

    file: str
    defines: dict[str, str]
    variables: tuple[Variable, ...]


class TaskType(StrEnum):
    """How a task is timed (section 3.8)."""

    PERIODIC = "periodic"
    SYNCHRONOUS = "synchronous"
    SPORADIC = "sporadic"
    DEFERRABLE = "deferrable"
    BACKGROUND = "background"


class Needs(StrEnum):
    """Need of a task, after ``NEEDS spp``: a device or a back end."""

    CUDA = "cuda"
    WARP = "warp"
    TORCH = "torch"
    NUMPY = "numpy"


class LocalLine(Struct, frozen=True):
    """One line of the LOCAL part: the words after the key, not yet decoded."""

    words: tuple[str, ...]
    place: Place | None = None


class Rmod(Struct, frozen=True, kw_only=True):
    """A ``.rmod`` file: a module configured for use (section 3.8).

    Port names are the module's own; `svar_name` gives the variable of one. Those of a
    combination (section 3.8.1) are the variables of its parts.
    """

    name: str
    """The RMOD's name: the file's name without ``.rmod``."""
    file: str
    module: str
    """Of a combination: the modules of its parts, with ``+`` between."""
    desc: str = ""
    parts: tuple[Rmod, ...] = ()
    """The RMODs that a combination runs as one task, in order."""
    aliases: dict[str, str] = {}
    """The module's name of a port, and the variable that stands for it."""
    inconst: tuple[str, ...] = ()
    outconst: tuple[str, ...] = ()
    invar: tuple[str, ...] = ()
    outvar: tuple[str, ...] = ()
    tasktype: TaskType = TaskType.PERIODIC
    freq: float | None = None
    """Hz; also when the file says PERIOD. None for aperiodic servers."""
    critical: bool = False
    capacity: float | None = None
    minc: float | None = None
    maxc: float | None = None
    effc: float | None = None
    """E of a soft task (section 6.4), seconds; None: read from its profile."""
    softness: float | None = None
    crit: int | None = None
    handler: int | None = None
    """Criticality of the handler of timing failures; None for the task's own."""
    stale: str | None = None
    """The action while an input is too old: a value of `pbonet.ports.Stale`. None: as
    the module's ports say."""
    settle: float | None = None
    """Seconds that all inputs must have been fresh before it goes on; None: until each
    has come twice more."""
    safe_at: tuple[str, ...] = ()
    """Timing failures of a cycle at which the out-vars get their safe values: values of
    `pbonet.pbo.TimingFailure`."""
    rtpu: str | None = None
    needs: Needs | None = None
    """Device or back end that a processor of the machine must have."""
    local: dict[str, LocalLine] = {}
    places: dict[str, Place] = {}
    """Where each keyword stands, for faults that are found later."""

    @property
    def settings(self) -> dict[str, LocalLine]:
        """The LOCAL lines that count; a parameter of a part is ``part.NAME``.

        A line of the combination takes precedence over that of the part's own file.
        """
        found = {
            f"{part.name}.{key}": line
            for part in self.parts
            for key, line in part.settings.items()
        }
        told = {key.lower() for key in self.local}
        kept = {key: line for key, line in found.items() if key.lower() not in told}
        return {**kept, **self.local}

    def svar_name(self, port: str) -> str:
        """Return the variable to which the module's port `port` is mapped."""
        return self.aliases.get(port, port)


class Scheduler(StrEnum):
    """The scheduling algorithm of an RTPU (section 6.2)."""

    MUF = "MUF"
    EDF = "EDF"
    RM = "RM"


class Usage(StrEnum):
    """Whether other subsystems may use the RTPU too (section 4.5.1)."""

    EXCLUSIVE = "exclusive"
    SHARED = "shared"


class ErrPrint(StrEnum):
    """Which messages are displayed at run time (section 4.5.1)."""

    ERRORS = "errors"
    WARNINGS = "warnings"
    NONE = "none"


class RtpuEntry(Struct, frozen=True, kw_only=True):
    """One RTPU that a subsystem may use (section 4.5.1)."""

    name: str
    scheduler: Scheduler = Scheduler.MUF
    usage: Usage = Usage.EXCLUSIVE
    errprint: ErrPrint = ErrPrint.WARNINGS
    minfreq: float = 1.0
    maxfreq: float = 1000.0
    hangtime: float = 0.1
    """Seconds of CPU time after which a cycle that has used up its period hangs."""
    place: Place | None = None


class SbsFile(Struct, frozen=True, kw_only=True):
    """A ``.sbs`` file: how a subsystem's hardware is set up (sections 4.3, 4.5.1)."""

    file: str
    subsystem: str
    svarfile: str
    master: str | None = None
    """The RTPU that keeps the table; None means the first one named."""
    strict: bool = False
    """Whether a configuration is refused that has something unsafe."""
    alone: float = 2.0
    """Seconds without a sign of life from the keeper's machine after which the flag
    goes up on another machine; 0: never."""
    rtpus: tuple[RtpuEntry, ...]

    @property
    def keeper(self) -> str:
        """The name of the RTPU that creates and keeps the table."""
        return self.master or self.rtpus[0].name


class JobTask(Struct, frozen=True, kw_only=True):
    """One TASK line of a job."""

    rmod: str
    rtpu: str | None = None
    fixed: bool = False
    """It stays on that RTPU when tasks are allocated (``pbonet allocate``)."""
    freq: float | None = None
    fallback: str | None = None
    """The RMOD that stands by to take its place when it fails."""
    takeover: float = 0.0
    """Seconds without the original after which a standby on another RTPU takes over by
    itself; 0: only by `swap`."""
    restart: Restart = "off"
    """Treatment of it, and of its fallback, when the RTPU process or the machine was
    lost."""
    place: Place | None = None

    @property
    def job_places(self) -> dict[str, Place]:
        """The places in the job of settings that an RMOD could have too."""
        said = {
            "TASK": True,
            "RTPU": bool(self.rtpu),
            "RESTART": self.restart != "off",
        }
        return {key: self.place for key, there in said.items() if there and self.place}


class RecordLine(Struct, frozen=True):
    """A RECORD line: how tasks or variables are recorded, or everything."""

    mode: str
    """``off``, ``outputs`` or ``all``; ``last`` with seconds as its name."""
    names: tuple[str, ...] = ()
    """Tasks and variables; none for all tasks that no line names."""
    place: Place | None = None


class Condition(Struct, frozen=True):
    """A PRE or POST condition, as written."""

    text: str
    place: Place | None = None


class JobFile(Struct, frozen=True, kw_only=True):
    """A ``.job`` file: a task set with the conditions around it (section 3.2)."""

    file: str
    name: str
    desc: str = ""
    sbs: str
    """The subsystem's ``.sbs`` file, relative to the job's folder."""
    pre: tuple[Condition, ...] = ()
    post: tuple[Condition, ...] = ()
    cost: Condition | None = None
    """COST line: the error that ``pbonet tune`` makes small."""
    tasks: tuple[JobTask, ...]
    off_order: tuple[str, ...] = ()
    """OFF line: the order in which tasks are turned off; empty means the reverse."""
    record: tuple[RecordLine, ...] = ()


class StepEnd(Struct, frozen=True):
    """An end of a step: a signal, or a condition."""

    signal: str = ""
    task: str = ""
    """The sender of the signal; empty: any task."""
    condition: str = ""
    """Instead of a signal: what is to hold."""
    place: Place | None = None

    def __str__(self) -> str:
        """Return it as a ``.seq`` file has it."""
        if self.condition:
            return f"({self.condition})"
        return f"{self.task} {self.signal}" if self.task else self.signal


class Step(Struct, frozen=True, kw_only=True, tag_field="keyword", tag="STEP"):
    """A STEP line: a job to change to, and what ends the step."""

    job: str
    label: str = ""
    until: tuple[StepEnd, ...] = ()
    """One of these ends the step; none of them, and no `seconds`: it ends at once."""
    seconds: float | None = None
    """After so many seconds it ends in any case."""
    within: float | None = None
    """Seconds after which it has failed; None: as the sequence says."""
    otherwise: str = ""
    """The step that follows an error; empty: none, the sequence fails."""
    place: Place | None = None

    @property
    def name(self) -> str:
        """Its label, or its job's name."""
        return self.label or self.job

    @property
    def waits(self) -> bool:
        """Whether it lasts until something happens."""
        return bool(self.until) or self.seconds is not None


class Goto(Struct, frozen=True, kw_only=True, tag_field="keyword", tag="GOTO"):
    """A GOTO line: another step follows, always or in one case."""

    step: str
    when: StepEnd | None = None
    """How the step above has ended, or what holds now; None: always."""
    place: Place | None = None


class Repeat(Struct, frozen=True, kw_only=True, tag_field="keyword", tag="REPEAT"):
    """A REPEAT line: the lines up to its END are done several times."""

    times: int
    """0: without end."""
    place: Place | None = None


class EndRepeat(Struct, frozen=True, kw_only=True, tag_field="keyword", tag="END"):
    """An END line: the end of the lines that are repeated."""

    place: Place | None = None


class Finish(Struct, frozen=True, kw_only=True, tag_field="keyword", tag="FINISH"):
    """A DONE or FAIL line: the sequence ends."""

    failed: bool = False
    text: str = ""
    place: Place | None = None


class Order(Struct, frozen=True, kw_only=True, tag_field="keyword", tag="ORDER"):
    """A SPAWN, KILL, SET or WRITE line: what the command of that name does."""

    command: Literal["spawn", "kill", "set", "write"]
    words: tuple[str, ...]
    """Its arguments, in the command's order."""
    place: Place | None = None


SeqLine: TypeAlias = Step | Goto | Repeat | EndRepeat | Finish | Order


class SeqFile(Struct, frozen=True, kw_only=True):
    """A ``.seq`` file: a program of jobs."""

    file: str
    name: str
    desc: str = ""
    sbs: str
    """The subsystem's ``.sbs`` file, relative to the file's folder."""
    safe: Step | None = None
    """Where an abort, and an error that no step takes, lead to."""
    wait: float = 0.0
    """Seconds that PRE and POST may take to become true when a step begins."""
    within: float | None = None
    """Seconds after which a step has failed, unless it says so itself; None: never."""
    lines: tuple[SeqLine, ...]

    @property
    def steps(self) -> list[Step]:
        """Its STEP lines."""
        return [line for line in self.lines if isinstance(line, Step)]

    @property
    def jobs(self) -> list[str]:
        """The names of its jobs, each once; with the safe one."""
        safe = [self.safe] if self.safe else []
        return list(dict.fromkeys(one.job for one in (*self.steps, *safe)))

    def at(self, step: str) -> int:
        """Return the index of the line of a step, by its name."""
        return next(
            number
            for number, line in enumerate(self.lines)
            if isinstance(line, Step) and line.name == step
        )


class AgentConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``agent.toml``: what belongs to a machine and not to an application."""

    name: str | None = None
    domain: str = "default"
    core: int | None = None
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    routers: tuple[str, ...] = ()
    """Endpoints of routers, the nearest first: the agent is a client of one of them."""
    libraries: tuple[str, ...] = ()
    """Folders with modules, beside the library that pbonet brings."""
    grace: float = 5.0
    """Seconds that control continues when the agent is gone."""
    keys: str | None = None
    """The key folder with which the agent proves who it is (``pbonet keys``)."""
    insecure: bool = False
    """True lets the agent listen beyond this machine without protection."""
    multicast: bool = False
    """True lets the agents of the domain on one network find each other."""
    awake: bool = False
    """True keeps the machine's processors from sleeping while the RTPU is there."""
    core_share: float | None = None
    """Share of the core that may be planned; None: what the kernel grants."""
    files: str | None = None
    """Folder whose files others may use (``pbonet://NAME/...``); none if left out."""
    runs: str | None = None
    """Folder of the logs; ``runs`` in the working directory by default."""
    log_mb: float = 1000.0
    """A log that has grown so far continues in another file; 0: never."""
    log_minutes: float = 0.0
    """The same by time."""
    runs_mb: float = 0.0
    """Most space for all logs in that folder; the oldest are removed. 0: no limit."""
    metrics: str | None = None
    """``HOST:PORT`` of the metrics for Prometheus; none are served if left out."""
    events: dict[str, str] = {}
    """Queues of the RTPU, and the keys whose messages go into them."""
    device: dict[str, Entry] = {}
    """I/O devices of the machine by logical name."""
    spp: dict[str, SppEntry] = {}
    """Special purpose processors of the machine by name."""
