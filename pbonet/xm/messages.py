"""What travels between masters and agents: msgpack maps, defined once.

Every request is one map ``{"v", "id", "client", "subsystem", "epoch", "op", ...}``,
where ``op`` names the operation and the other fields are its arguments; an answer is
``{"v", "id", "ok", "result" | "error", "warnings"}``. Unknown fields are ignored, an
unknown version is refused with both numbers. A request repeated with the same id is
answered again and not executed twice.
"""

from __future__ import annotations

from typing import Any, TypeAlias

from msgspec import Struct

from pbonet.errors import WireError
from pbonet.xm import values

from .agents import AgentInfo as AgentInfo  # noqa: PLC0414 - taken from here
from .agents import LinkReport as LinkReport  # noqa: PLC0414 - taken from here
from .agents import TableNews as TableNews  # noqa: PLC0414 - taken from here
from .agents import Way as Way  # noqa: PLC0414 - taken from here

VERSION = 1
ParamValue: TypeAlias = values.ParamValue
Standing: TypeAlias = values.Standing
VarValue: TypeAlias = values.VarValue


class Request(Struct, kw_only=True, tag_field="op"):
    """What every request carries."""

    v: int = VERSION
    id: str = ""
    client: str = ""
    """The master's own name, unique; its liveliness token carries it too."""
    subsystem: str = ""
    epoch: int = 0
    """Of the claim; 0 where none is needed."""


class Hello(Request, tag="hello"):
    """Ask an agent who it is. Result: `AgentInfo`."""


class Links(Request, tag="links"):
    """Have an agent measure the way to every other one. Result: `LinkReport`."""


class Claim(Request, tag="claim"):
    """Reserve the RTPU for a subsystem (section 4.5.1). Result: `Claimed`.

    The same subsystem may claim again when the former master's token is gone, or with
    `take_over`; the epoch then rises and the former master's commands are refused.
    """

    usage: str = "exclusive"
    scheduler: str = "MUF"
    errprint: str = "warnings"
    minfreq: float = 1.0
    maxfreq: float = 1000.0
    take_over: bool = False


class Release(Request, tag="release"):
    """Give the RTPU back; refused while the subsystem has tasks on it. Result: None."""


class OpenTable(Request, tag="open_table"):
    """Create or attach the subsystem's table. Result: `TableInfo`.

    Refused when a table of that name stands with another layout.
    """

    svar: str
    """Text of the ``.svar`` file."""
    svar_name: str
    """Its name, for messages."""
    keep: bool = False
    """True on the RTPU that creates and keeps the table."""


class CloseTable(Request, tag="close_table"):
    """Detach from the table; the keeper removes it. Refused while tasks use it."""


class Spawn(Request, tag="spawn"):
    """Create a task from an RMOD (section 4.5.2); answered when it is OFF.

    Result: `TaskStatus`.
    """

    task: str
    """The task's name in the subsystem: the RMOD's name, unless told otherwise."""
    rmod: str
    """Text of the ``.rmod`` file."""
    rmod_name: str
    freq: float | None = None
    crit: int | None = None
    """None: assigned by the scheduler's rule (section 6.2.3)."""
    priority: int = 0
    """User priority, from the data flow (section 6.2.4); higher runs first."""
    effc: float | None = None
    """E of a soft task as measured, seconds; counts where the RMOD has no EFFC."""
    timeout: float = 10.0
    """Seconds that `init` may take."""


class Control(Request, tag="control"):
    """Send ``on off kill clear reinit`` to a task (4.5.3). Result: `TaskStatus`."""

    task: str
    signal: str
    arg: str = ""
    """Text for the module, as ``self.task.arg``."""
    timeout: float = 5.0


class Reconfig(Request, tag="reconfig"):
    """Send an ordered list of signals, acknowledged once (section 4.4.4).

    Result: `Reconfigured`. The first failure ends it.
    """

    items: list[tuple[str, str]]
    """Pairs of task and signal."""
    handover: list[str] = []
    """Tasks whose outputs a task on another RTPU takes over; of those on its own the
    agent knows by itself."""
    timeout: float = 5.0


class Freq(Request, tag="freq"):
    """Get (hz None) or set a task's frequency. Result: Hz as a float."""

    task: str
    hz: float | None = None


class Get(Request, tag="get"):
    """Ask for a task's parameters. Result: list of `ParamValue`."""

    task: str
    name: str | None = None


class Set(Request, tag="set"):
    """Change a parameter of a task between two cycles. Result: list of `ParamValue`."""

    task: str
    name: str
    value: str
    """As it would stand in a LOCAL line."""


class Rank(Request, tag="rank"):
    """Tell the criticality and user priority of tasks after a change. Result: None.

    A criticality of None leaves it to the scheduler's rule, which the RTPU knows best:
    it sees the tasks of every subsystem on its core. User priorities follow the data
    flow of the whole subsystem (section 6.2.4), which only its master sees.
    """

    tasks: dict[str, tuple[int | None, int]]


class Status(Request, tag="status"):
    """Ask for status; never touches a task. Result: `RtpuStatus`."""

    task: str | None = None


class Profile(Request, tag="profile"):
    """Ask for execution profiles; touches no task. Result: list of `TaskProfile`."""

    task: str | None = None


class Display(Request, tag="display"):
    """Ask for values of variables. Result: list of `VarValue`."""

    names: list[str] | None = None


class Write(Request, tag="write"):
    """Set a variable that no task writes, through the keeper. Result: `VarValue`."""

    name: str
    values: list[float]


class Modules(Request, tag="modules"):
    """Ask for the modules in the agent's libraries. Result: list of `ModuleInfo`."""

    name: str | None = None


class Stop(Request, tag="stop"):
    """Turn everything OFF in order and kill it; always accepted. Result: `Stopped`.

    An empty `subsystem` means every subsystem on the RTPU.
    """

    timeout: float = 2.0
    order: list[str] = []
    """Tasks to turn off first, in this order."""


class Flag(Request, tag="flag"):
    """Raise or clear an entry of the illegal-configuration flag (section 3.10).

    The raiser is the subsystem's master. It raises ``equation 2`` while a loop that is
    built by hand is not closed yet. Result: the causes that stand, a list of str.
    """

    cause: str
    up: bool


class Sigmask(Request, tag="sigmask"):
    """Get or set which signals of tasks nobody wants (section 4.4.4).

    Result: dict of the names masked, by task; ``""`` stands for the subsystem, whose
    mask holds for every task without one of its own.
    """

    task: str = ""
    """Whose mask is changed; empty: the subsystem's."""
    names: list[str] | None = None
    """The new mask; None: none is changed."""
    unset: bool = False
    """Remove the mask instead."""

    @property
    def changes(self) -> bool:
        """Whether it sets or removes a mask."""
        return self.unset or self.names is not None


class Job(Request, tag="job"):
    """Ask the keeper which job stands, tell it, or have it forget.

    Result: list of `Standing`, one or none. So whoever goes over to another job, maybe
    another master, finds the conditions under which the first one may be left.
    """

    told: Standing | None = None
    forget: bool = False

    @property
    def changes(self) -> bool:
        """Whether it says something, and does not only ask."""
        return self.forget or self.told is not None


class Events(Request, tag="events"):
    """Ask for the agent's last events. Result: list of `Event`."""

    since: int = 0
    """Number of the first event wanted."""


AnyRequest = (
    Hello
    | Links
    | Claim
    | Release
    | OpenTable
    | CloseTable
    | Spawn
    | Control
    | Reconfig
    | Freq
    | Get
    | Set
    | Rank
    | Status
    | Profile
    | Display
    | Write
    | Modules
    | Stop
    | Flag
    | Sigmask
    | Job
    | Events
)


class Claimed(Struct, kw_only=True):
    """A claim that was granted."""

    epoch: int
    tasks: list[str] = []
    """Tasks of the subsystem that stand on the RTPU already."""
    rmods: dict[str, str] = {}
    """Text of the ``.rmod`` that each of them was spawned from."""


class TableInfo(Struct, kw_only=True):
    """A table that stands on the machine."""

    name: str
    layout: str
    machine: str


class SectionStatus(Struct, kw_only=True):
    """One timed section of a task's cycle; CPU seconds."""

    count: int
    total: float
    min: float
    max: float


class TaskStatus(Struct, kw_only=True):
    """Everything that section 4.4.1 lists for one task, and a little more.

    Counters are totals since the task was turned on; each interface keeps its own
    baseline to show "since the last status".
    """

    rmod: str
    task: str
    rtpu: str
    tid: int
    """The task's process id."""
    S: str
    crit: int
    crit_assumed: bool = True
    """True while the criticality does not rest on a known MAXC."""
    priority: int = 0
    state: str
    cycle: int
    miss: int
    ref_f: float
    mez_f: float
    mez_t: float
    ptime: float
    on_ns: int = 0
    """CLOCK_MONOTONIC nanoseconds at which it was last turned on; 0: never."""
    tot_c: float
    tick: float
    min_c: float
    max_c: float
    last_c: float
    first_c: float = 0.0
    """CPU seconds of the first cycle since on; `now_c` of the one under way."""
    now_c: float = 0.0
    warn: int
    warning: str = ""
    error: str = ""
    jitter_max: float = 0.0
    """Largest delay from release to the first line of `cycle`, seconds."""
    jitter: list[int] = []
    """Histogram of that delay; bin k counts delays below 2**k microseconds."""
    faults: int = 0
    """Minor page faults since the task was turned on."""
    retries: int = 0
    """Copy-ins that met the retry bound."""
    module: str = ""
    version: str = ""
    transfer_in: float = 0.0
    """Mean seconds of a copy-in, and of a copy-out."""
    transfer_out: float = 0.0
    now: int = 0
    """CLOCK_MONOTONIC nanoseconds at which this was read."""
    ring: str = ""
    """Name of the ring in shared memory that gets one record a cycle."""
    rank: int = 0
    """Criticality at this moment: lower while a reserve is used up."""
    reserve: float = 0.0
    """CPU seconds reserved for each cycle, or for a server's period; 0 for none."""
    failures: dict[str, int] = {}
    """Timing failures by kind, since the task was spawned (section 6.3)."""
    overruns: int = 0
    """How often the reserve was used up."""
    aborted: int = 0
    """Cycles ended by the module's handler of timing failures."""
    skipped: int = 0
    """Releases left out: too late to begin, or because the handler said so."""
    handlers: int = 0
    """Calls of that handler."""
    delivery_max: float = 0.0
    """Longest time from the finding of a failure to its handler's begin, seconds."""
    held_off: int = 0
    """Critical sections that lasted too long, and were overruled."""
    sections: dict[str, SectionStatus] = {}
    """Timed sections by name (section 6.7.2)."""
    signals: dict[str, int] = {}
    """How often it has sent each signal since it was spawned, masked ones left out."""


class TbufStatus(Struct, kw_only=True):
    """A link between subsystems, as it stands on one machine (section 5.6)."""

    name: str
    writer: str
    """Who writes it there: a process, or the agent that brings it from another machine;
    empty: nobody."""
    reader: str
    """The same of who reads it."""
    number: int
    """Counter of the newest record; 0 before the first."""
    age: float | None = None
    """Of the newest record, seconds; None before the first."""


class RtpuStatus(Struct, kw_only=True):
    """Status of an RTPU and of the tasks asked for."""

    rtpu: str
    backend: str
    scheduler: str
    tasks: list[TaskStatus]
    util: float = 0.0
    """CPU share used by the tasks since the dispatcher started, of one core."""
    dispatcher: float = 0.0
    """CPU share used by the dispatcher."""
    stalls: int = 0
    """How often the core stood still for more than 20 ms."""
    stalled: float = 0.0
    """Seconds that it stood still, in all."""
    illegal: list[str] = []
    """Causes for which the illegal-configuration flag is up."""
    events: dict[str, dict[str, int]] = {}
    """How often each code of events came, by task; held-back ones are counted too."""
    tbufs: list[TbufStatus] = []
    """The links that stand on the machine, in this RTPU's domain."""


class TaskProfile(Struct, kw_only=True):
    """The profile of one task (section 6.7.1), and the status read with it."""

    status: TaskStatus
    least: float
    """CPU seconds of the shortest of the cycles in `cpu`; `most` of the longest."""
    most: float
    cpu: list[tuple[int, int]] = []
    """Bins of `pbonet.sched.histogram` that count cycles by CPU time, and the counts;
    since the task was spawned, without the first cycle after each `on`."""
    jitter: list[tuple[int, int]] = []
    """The same for delays from release to cycle, every cycle."""
    late: int = 0
    """Cycles that ended after their deadline, since the task was spawned."""
    failed: int = 0
    """Cycles in which the module raised, since then."""


class Reconfigured(Struct, kw_only=True):
    """How far a reconfiguration came."""

    done: int
    states: dict[str, str] = {}
    error: WireError | None = None
    """Of item number `done`; the rest was not sent."""


class Stopped(Struct, kw_only=True):
    """What a stop did."""

    off: list[str]
    killed: list[str]
    """Tasks that did not stop by themselves and were ended."""


class Event(Struct, kw_only=True):
    """Something that happened, with its place and cycle."""

    n: int
    time: int
    """CLOCK_MONOTONIC nanoseconds on the machine."""
    wall: float
    """For people to read."""
    severity: int
    code: str
    rtpu: str
    subsystem: str = ""
    task: str = ""
    cycle: int = 0
    bits: int = 0
    """Signals that a module sent, as bits of `pbonet.Signal` (section 4.4.4)."""
    errnum: int = 0
    """The number that the module gave the error or warning, 0 for none."""
    place: str = ""
    """Where in the module's code it happened, ``file:line in method``, if known."""
    text: str


class Answer(Struct, kw_only=True):
    """The answer to a request."""

    v: int = VERSION
    id: str = ""
    ok: bool
    result: Any = None
    error: WireError | None = None
    warnings: list[str] = []
