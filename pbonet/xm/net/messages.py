"""Messages between masters and agents: msgpack maps, defined once.

Every request is one map ``{"v", "id", "client", "subsystem", "epoch", "op", ...}``,
where ``op`` names the operation and the other fields are its arguments; an answer is
``{"v", "id", "ok", "result" | "error", "warnings"}``. Unknown fields are ignored; an
unknown version is refused with both version numbers. A request repeated with the same
id gets the same answer and is not executed twice.
"""

from __future__ import annotations

from typing import Annotated as A, Any, TypeAlias

from msgspec import Meta, Struct

from pbonet.errors import WireError
from pbonet.versions import LAYERS

from . import message_parts as values
from .agents import (
    HELD_REMEDY as HELD_REMEDY,  # noqa: PLC0414 - taken from here
    AgentInfo as AgentInfo,  # noqa: PLC0414 - taken from here
    DeviceFault as DeviceFault,  # noqa: PLC0414 - taken from here
    DeviceInfo as DeviceInfo,  # noqa: PLC0414 - taken from here
    LinkReport as LinkReport,  # noqa: PLC0414 - taken from here
    Lost as Lost,  # noqa: PLC0414 - taken from here
    MachineInfo as MachineInfo,  # noqa: PLC0414 - taken from here
    PortUser as PortUser,  # noqa: PLC0414 - taken from here
    TableNews as TableNews,  # noqa: PLC0414 - taken from here
    Way as Way,  # noqa: PLC0414 - taken from here
    held as held,  # noqa: PLC0414 - taken from here
    mismatched as mismatched,  # noqa: PLC0414 - taken from here
)
from .statuses import (
    CoreTrace as CoreTrace,  # noqa: PLC0414
    CoreUse as CoreUse,  # noqa: PLC0414
    RtpuStatus as RtpuStatus,  # noqa: PLC0414
    SectionStatus as SectionStatus,  # noqa: PLC0414
    SppStatus as SppStatus,  # noqa: PLC0414
    TaskProfile as TaskProfile,  # noqa: PLC0414
    TaskStatus as TaskStatus,  # noqa: PLC0414
    TbufStatus as TbufStatus,  # noqa: PLC0414
)

VERSION = LAYERS["commands"].newest
"""Version of the messages that this pbonet makes, unless it says another one."""
MOST_CALLERS = 32
"""Maximum number of tasks for which one successor can wait."""
MOST_EXTRA = 2.0
"""Share of the limit of a signal or spawn that is added if the task's core is busy."""
LONGEST_TRACE = 30.0
"""Seconds for which a core is followed at most."""
LAST_TICKET = (1 << 31) - 1
Restart: TypeAlias = values.Restart
_Word: TypeAlias = A[int, Meta(ge=0, lt=1 << 32)]
ParamValue: TypeAlias = values.ParamValue
Standing: TypeAlias = values.Standing
VarValue: TypeAlias = values.VarValue


class Request(Struct, kw_only=True, tag_field="op"):
    """Fields of every request."""

    v: int = VERSION
    id: str = ""
    client: str = ""
    """The master's unique name; also in its liveliness token."""
    subsystem: str = ""
    epoch: int = 0
    """Epoch of the claim; 0 if none is needed."""


class Hello(Request, tag="hello"):
    """Ask an agent for its identity. Result: `AgentInfo`."""


class Links(Request, tag="links"):
    """Ask for the latency from an agent to all others. Result: `LinkReport`."""

    measure: bool = True
    """Measure it now; False: report the last round trips, which are made each second,
    and send none."""


class Devices(Request, tag="devices"):
    """Ask for the I/O devices of an agent. Result: list of `DeviceInfo`."""


class Machine(Request, tag="machine"):
    """Ask for the clock and the disk of an agent's machine. Result: `MachineInfo`."""


class Claim(Request, tag="claim"):
    """Reserve the RTPU for a subsystem (section 4.5.1). Result: `Claimed`.

    The same subsystem may claim again when the former master's token is gone, or with
    `take_over`; the epoch then increases and the former master's commands are refused.
    With `probe` the RTPU only answers what it would answer, and changes nothing.

    A claim that carries an `epoch` gets it where the RTPU process knows no claim of the
    subsystem, because it is new: so the commands of its master are valid again.

    With the text of a ``.svar`` file the subsystem's table is opened, too: it is
    created, or attached if the machine already has it. A table with another layout is
    refused, and the claim is then unchanged.
    """

    usage: str = "exclusive"
    scheduler: str = "MUF"
    errprint: str = "warnings"
    minfreq: float = 1.0
    maxfreq: float = 1000.0
    hangtime: float = 0.1
    take_over: bool = False
    probe: bool = False
    svar: str = ""
    """Text of the ``.svar`` file; empty: the table is not touched."""
    svar_name: str = ""
    """Its name, for messages."""
    keep: bool = False
    """True on the RTPU that creates and keeps the table."""
    keeper: str = ""
    """The name of that RTPU; empty: its loss is not noticed."""
    alone: float = 2.0
    """Seconds without a sign of life from its machine after which the flag goes up on
    another machine; 0: never."""


class Release(Request, tag="release"):
    """Release the RTPU; refused while the subsystem has tasks on it. Result: None."""


class CloseTable(Request, tag="close_table"):
    """Detach from the table; the keeper removes it. Refused while tasks use it."""


class Spawn(Request, tag="spawn"):
    """Create a task from an RMOD (section 4.5.2); answered when it is OFF.

    Result: `TaskStatus`.
    """

    task: str
    """The task's name in the subsystem; by default the RMOD's name."""
    rmod: str
    """Text of the ``.rmod`` file."""
    rmod_name: str
    freq: float | None = None
    crit: int | None = None
    """None: assigned by the scheduler's rule (section 6.2.3)."""
    priority: int = 0
    """User priority, from the data flow (section 6.2.4); higher runs first."""
    effc: float | None = None
    """E of a soft task as measured, seconds; used if the RMOD has no EFFC."""
    timeout: float = 10.0
    """Time limit of `init` in seconds."""
    replaces: list[str] = []
    """Tasks that it replaces: it takes over their constants, whatever the values."""
    restart: Restart = "off"
    """Treatment by the agent when the RTPU process or the machine was lost:
    ``never``: nothing; ``off``: it is spawned again; ``on``: it is also turned on if it
    was ON, unless it is a robot interface."""
    missed: bool = False
    """Whether it was ON when it was lost: the illegal-configuration flag stays up until
    its variables are written."""


class Gone(Request, tag="gone"):
    """Note a task that was lost with an RTPU process before this one, as one that died.

    If it was ON, the illegal-configuration flag is up until its variables are written.
    Result: `TaskStatus`.
    """

    task: str
    rmod: str
    """Text of its ``.rmod`` file."""
    rmod_name: str
    error: str
    """How it was lost."""
    was_on: bool = False


class Control(Request, tag="control"):
    """Send ``on off kill clear reinit`` to a task (4.5.3). Result: `TaskStatus`."""

    task: str
    signal: str
    arg: str = ""
    """Text for the module, as ``self.task.arg``."""
    timeout: float = 5.0
    replaces: list[str] = []
    """For ``reinit``: tasks that it replaces; it takes over their constants."""


class Call(Struct, kw_only=True):
    """How a task that has ended engages its successor, a standby."""

    successor: str
    outputs: list[str]
    """The variables that the successor writes; for a call from another machine also
    those that the caller wrote."""
    core: A[int, Meta(ge=0, lt=1024)]
    slot: A[int, Meta(ge=0, lt=128)]
    life: _Word
    """Of the slot: identifies the task that has it."""
    ticket: A[int, Meta(ge=0, le=LAST_TICKET)]
    """Identifies this exchange."""
    caller: A[int, Meta(ge=0, lt=MOST_CALLERS)]
    """Index of the caller, from 0."""
    far: bool = False
    """The successor is on another machine: the agents call, with the table's data."""


class Successors(Request, tag="successors"):
    """Make tasks standbys that take over from tasks on other RTPUs.

    Result: for each predecessor, by name, a list of `Call` to be passed in
    `Reconfig.calls` there. An ``on`` in a list then waits until the successor is ON.
    """

    after: dict[str, A[list[str], Meta(max_length=MOST_CALLERS)]]
    """The successors, and for each its predecessors; an empty list: none, it is no
    longer a standby."""
    timeout: float = 5.0
    """Seconds after which they are no longer standbys."""
    far: list[str] = []
    """Predecessors on other machines."""


class Reconfig(Request, tag="reconfig"):
    """Send an ordered list of signals, acknowledged once (section 4.4.4).

    An ``off`` and the ``on`` of a task that takes over its variables are carried out
    together, and so are several such pairs in parallel: the dispatcher releases the
    new task when the old one ends. Result: `Reconfigured`. The first failure ends the
    list.
    """

    items: list[tuple[str, str]]
    """Pairs of task and signal."""
    handover: dict[str, list[str]] = {}
    """For tasks that go off, here or elsewhere, the variables that a later task takes
    over, on any RTPU."""
    timeout: float = 5.0
    calls: dict[str, list[Call]] = {}
    """For tasks of the list, the calls that each makes when its `off` has ended."""
    slowest: float = 0.0
    """Period in seconds of the slowest task that leaves on another RTPU at the same
    time; successors get this much longer to take over."""


class Standby(Request, tag="standby"):
    """Make a task the fallback of another one. Result: `TaskStatus`.

    On one RTPU: whenever the original is ON and the standby OFF, the standby is ready
    to run; the dispatcher releases it when the original goes to ERROR or dies. Of a
    task on another RTPU: the agent has it turned ON when that one is lost.
    """

    task: str
    """The standby."""
    original: str
    """Empty: it is no longer a standby."""
    rtpu: str = ""
    """The RTPU of the original, if it is another one."""
    takeover: float = 0.0
    """Seconds without that original after which it is turned ON; 0: never."""
    ready: bool = False
    """The original on another RTPU is ON. False: it is not, or is about to be turned
    off by an order, and is not replaced."""


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
    """As written in a LOCAL line."""


class Rank(Request, tag="rank"):
    """Set the criticality and user priority of tasks after a change. Result: None.

    With a criticality of None the RTPU applies the scheduler's rule, because it knows
    the tasks of every subsystem on its core. User priorities follow the data flow of
    the whole subsystem (section 6.2.4), which only its master knows.
    """

    tasks: dict[str, tuple[int | None, int]]


class Status(Request, tag="status"):
    """Ask for status; does not disturb tasks. Result: `RtpuStatus`."""

    task: str | None = None
    reset: bool = False
    """Restart the extremes of the CPU time, which the result still contains."""


class Profile(Request, tag="profile"):
    """Ask for execution profiles, without disturbing tasks.

    Result: list of `TaskProfile`.
    """

    task: str | None = None


class TraceCore(Request, tag="trace_core"):
    """Follow who has the core until a task misses a release. Result: `CoreTrace`.

    The kernel reports each change of the core's thread meanwhile, so it is
    no request of observers.
    """

    task: str
    seconds: float = 5.0
    """How long at most; above 0, up to `LONGEST_TRACE`."""


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
    """Turn all tasks OFF in order and kill them; always accepted. Result: `Stopped`.

    An empty `subsystem` means every subsystem on the RTPU.
    """

    timeout: float = 2.0
    order: list[str] = []
    """Tasks to turn off first, in this order."""
    stop_id: str = ""
    """Identity of the order. An RTPU carries an order out once; agents repeat it to
    RTPUs that were out of reach."""


class Replaced(Request, tag="replaced"):
    """Turn tasks OFF in whose place others are now; always accepted. Result: `Stopped`.

    It is sent to every RTPU that is in reach, for those that are not: agents repeat it
    there as they repeat a ``stop``.
    """

    stop_id: str
    """As in `Stop`."""
    tasks: dict[str, list[str]]
    """The tasks, by RTPU."""
    timeout: float = 2.0


class Flag(Request, tag="flag"):
    """Raise or clear an entry of the illegal-configuration flag (section 3.10).

    The raiser is the subsystem's master. It raises ``equation 2`` while a loop that is
    built by hand is not closed yet. Result: the current causes, a list of str.
    """

    cause: str
    up: bool
    unwritten: list[str] = []
    """Variables without a writer: the entry is removed when all of them have one, and
    not raised if they already have."""


class Sigmask(Request, tag="sigmask"):
    """Get or set which signals of tasks are ignored (section 4.4.4).

    Result: dict of the masked signals' names, by task; the key ``""`` is the subsystem,
    whose mask applies to every task without one of its own.
    """

    task: str = ""
    """The task whose mask is changed; empty: the subsystem's mask."""
    names: list[str] | None = None
    """The new mask; None: no change."""
    unset: bool = False
    """Remove the mask instead."""

    @property
    def changes(self) -> bool:
        """Whether it sets or removes a mask."""
        return self.unset or self.names is not None


class Job(Request, tag="job"):
    """Get, set or clear the current job, which the keeper stores.

    Result: list of `Standing`, with at most one entry. A master that switches to
    another job, maybe a new master, reads there the conditions for leaving the first.
    """

    told: Standing | None = None
    forget: bool = False
    note: str = ""
    """The reason, such as the step of a sequence, for the event STEP."""

    @property
    def changes(self) -> bool:
        """Whether it changes the job and does not only ask."""
        return self.forget or self.told is not None


class Record(Request, tag="record"):
    """Record the subsystem's tasks on this RTPU from now on. Result: `Recorded`.

    Recording ends when the RTPU is released, or with mode ``off``.
    """

    run: str = ""
    """Name of the run, and of its folder."""
    file: str = "run"
    """Name of the log, without ``.mcap``."""
    job: str = ""
    mode: str = "outputs"
    """``off``; ``outputs``; or ``all``, which adds the inputs of every cycle."""
    tasks: dict[str, str] = {}
    """Modes of single tasks."""
    hidden: list[str] = []
    """Variables that are not recorded."""
    files: dict[str, str] = {}
    """Configuration files to attach: text by name."""
    last: float = 0.0
    """Keep this many seconds in memory, and write them when an error occurs; 0: write
    everything."""


class Events(Request, tag="events"):
    """Ask for the agent's last events. Result: list of `Event`."""

    since: int = 0
    """Number of the first event wanted."""


AnyRequest = (
    Hello
    | Links
    | Devices
    | Machine
    | Claim
    | Release
    | CloseTable
    | Spawn
    | Gone
    | Control
    | Successors
    | Reconfig
    | Standby
    | Freq
    | Get
    | Set
    | Rank
    | Status
    | Profile
    | TraceCore
    | Display
    | Write
    | Modules
    | Stop
    | Replaced
    | Flag
    | Sigmask
    | Job
    | Record
    | Events
)


class Claimed(Struct, kw_only=True):
    """A granted claim."""

    epoch: int
    tasks: list[str] = []
    """Existing tasks of the subsystem on the RTPU."""
    critical: list[str] = []
    """Names of those tasks that are CRITICAL and ON."""
    taken_from: str = ""
    """The master that lives and had the claim before; empty if there is none."""
    rmods: dict[str, str] = {}
    """Text of the ``.rmod`` that each of them was spawned from."""
    modules: dict[str, Any] = {}
    """The module of each of them, described as by the request ``modules``."""
    status: RtpuStatus | None = None
    """The result of ``status``, which saves the master a request."""
    agent: AgentInfo | None = None
    """The result of ``hello``."""


class Recorded(Struct, kw_only=True):
    """The destination of a recording."""

    path: str
    """The log on the agent's machine; empty if recording has ended."""
    machine: str


class Reconfigured(Struct, kw_only=True):
    """The result of a reconfiguration, which may be incomplete."""

    done: int
    states: dict[str, str] = {}
    error: WireError | None = None
    """Error of the first item of `rest`."""
    rest: list[tuple[str, str]] = []
    """Items that were not carried out, the failed one first; empty on success. Tasks
    that are exchanged together may fail in another order than that of the list."""


class Stopped(Struct, kw_only=True):
    """The result of a stop."""

    off: list[str]
    killed: list[str]
    """Tasks that did not stop by themselves and were killed."""
    failed: dict[str, str] = {}
    """Tasks whose `off` or `kill` failed, or that died, and how; they have ended."""


class Event(Struct, kw_only=True):
    """An event, with its place and cycle."""

    n: int
    time: int
    """CLOCK_MONOTONIC nanoseconds on the machine."""
    wall: float
    """Wall-clock time, for display."""
    severity: int
    code: str
    rtpu: str
    subsystem: str = ""
    task: str = ""
    cycle: int = 0
    bits: int = 0
    """Signals that a module sent, as bits of `pbonet.Signal` (section 4.4.4)."""
    errnum: int = 0
    """The number that the module gave the error or warning; 0: none."""
    place: str = ""
    """Place in the module's code, ``file:line in method``, if known."""
    state: str = ""
    """The task's state at that time, for events of a task."""
    text: str


class Answer(Struct, kw_only=True):
    """The answer to a request."""

    v: int = VERSION
    id: str = ""
    ok: bool
    result: Any = None
    error: WireError | None = None
    warnings: list[str] = []
