"""The status of RTPUs and tasks, as sent in messages (Stewart 1994, section 4.4.1)."""

from __future__ import annotations

from msgspec import Struct

from pbonet.versions import Range

from .message_parts import Restart


class SectionStatus(Struct, kw_only=True):
    """One timed section of a task's cycle; CPU seconds."""

    count: int
    total: float
    min: float
    max: float


class TaskStatus(Struct, kw_only=True):
    """The status of one task: everything that section 4.4.1 lists, and more.

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
    """True unless the criticality is based on a known MAXC."""
    priority: int = 0
    state: str
    cycle: int
    miss: int
    """Releases without a cycle."""
    failed: int = 0
    """Cycles in which the module raised an error, or its outputs were refused."""
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
    """The newest one since `on`."""
    error: str = ""
    jitter_max: float = 0.0
    """Largest delay from release to the first line of `cycle`, seconds."""
    jitter: list[int] = []
    """Histogram of that delay; bin k counts delays below 2**k microseconds."""
    faults: int = 0
    """Minor page faults since the task was turned on."""
    retries: int = 0
    """Copy-ins that reached the retry limit."""
    module: str = ""
    version: str = ""
    transfer_in: float = 0.0
    """Mean duration in seconds of a copy-in, and of a copy-out."""
    transfer_out: float = 0.0
    now: int = 0
    """CLOCK_MONOTONIC nanoseconds at which this was read."""
    ring: str = ""
    """Name of the ring in shared memory that gets one record per cycle."""
    lost: int = 0
    """Records that did not fit the ring since the task was spawned."""
    rank: int = 0
    """Current criticality: lower while a reserve is used up."""
    reserve: float = 0.0
    """CPU seconds reserved for each cycle, or for a server's period; 0 for none."""
    failures: dict[str, int] = {}
    """Timing failures by kind, since the task was spawned (section 6.3)."""
    overruns: int = 0
    """Number of times the reserve was used up."""
    aborted: int = 0
    """Cycles ended by the module's handler of timing failures."""
    skipped: int = 0
    """Skipped releases: too late to begin, or on the handler's request."""
    handlers: int = 0
    """Calls of that handler."""
    delivery_max: float = 0.0
    """Longest time from the detection of a failure to its handler's start, seconds."""
    made_safe: int = 0
    """Cycles that failed in time and whose out-vars got their safe values at once."""
    made_safe_max: float = 0.0
    """Longest time from the failure until those were in the table, seconds."""
    held_off: int = 0
    """Critical sections that lasted too long and were cut short."""
    sections: dict[str, SectionStatus] = {}
    """Timed sections by name (section 6.7.2)."""
    fallback_of: str = ""
    """The task whose fallback it is."""
    original_rtpu: str = ""
    """The RTPU of that task, if it is another one."""
    takeover: float = 0.0
    """Seconds without that task after which it takes over by itself; 0: never."""
    stands_by: bool = False
    """Whether it is ready to be released in place of that task."""
    waits: str = ""
    """How long its cycles wait for other things than the core; empty: they do not."""
    restart: Restart = "off"
    """``never``, ``off`` or ``on``, as it was spawned; see `Spawn.restart`."""
    restarted: str = ""
    """The agent's treatment of it when it was lost, until it is ON or was killed."""
    signals: dict[str, int] = {}
    """Number of signals of each kind sent since it was spawned, without masked ones."""


class TbufStatus(Struct, kw_only=True):
    """State of a link between subsystems on one machine (section 5.6)."""

    name: str
    writer: str
    """Its writer there: a process, or the agent that receives it from another machine;
    empty: none."""
    reader: str
    """Its reader, likewise."""
    number: int
    """Counter of the newest record; 0 before the first."""
    age: float | None = None
    """Age of the newest record, seconds; None before the first."""


class SppStatus(Struct, kw_only=True):
    """State of a special purpose processor (section 7.4)."""

    name: str
    back_end: str
    """The first choice of its libraries; empty while its executive does not run."""
    device: str
    pid: int
    starts: int
    """How often its executive was started."""
    batches: int
    libraries: list[str]
    """Libraries of its clients, as ``FILE on BACK_END DEVICE``."""
    error: str = ""
    """Why it does not run."""


class RtpuStatus(Struct, kw_only=True):
    """Status of an RTPU and of the requested tasks."""

    rtpu: str
    backend: str
    scheduler: str
    tasks: list[TaskStatus]
    util: float = 0.0
    """Share of one core used by the tasks since the dispatcher started."""
    dispatcher: float = 0.0
    """Share of one core used by the dispatcher."""
    stalls: int = 0
    """Number of times the core stalled for more than 20 ms."""
    stalled: float = 0.0
    """Total duration of these stalls in seconds."""
    stall_age: float | None = None
    """Seconds since the last stall ended: 0 while one lasts, None if there was none."""
    illegal: list[str] = []
    """Causes for which the illegal-configuration flag is up."""
    log: str = ""
    """The log that is being written; empty if none."""
    unlogged: int = 0
    """Records that could not be written to it."""
    events: dict[str, dict[str, int]] = {}
    """Number of events of each code, by task, including suppressed ones."""
    tbufs: list[TbufStatus] = []
    """The links on the machine, in this RTPU's domain."""
    spps: list[SppStatus] = []
    """The special purpose processors of the machine that this RTPU can use."""
    age: float = 0.0
    """Seconds since the start of the RTPU process; 0: not known."""
    versions: dict[str, Range] = {}
    """As in `AgentInfo`."""


class TaskProfile(Struct, kw_only=True):
    """The profile of one task (section 6.7.1), and the status read with it."""

    status: TaskStatus
    least: float
    """CPU seconds of the shortest cycle in `cpu`; `most` is that of the longest."""
    most: float
    cpu: list[tuple[int, int]] = []
    """Bins of `histogram` and the number of cycles with that CPU time, since the task
    was spawned; without the first cycle after each `on`."""
    jitter: list[tuple[int, int]] = []
    """The same for delays from release to cycle, every cycle."""
    late: int = 0
    """Cycles that ended after their deadline, since the task was spawned."""
    failed: int = 0
    """Cycles in which the module raised, since the task was spawned."""


class CoreUse(Struct, frozen=True, kw_only=True):
    """A thread that had a core for some time."""

    pid: int
    """0: no thread had it."""
    name: str
    """The task, if it is one of the core; else what the kernel calls the thread."""
    known: bool = False
    """It is a task of the core, or its dispatcher."""
    seconds: float


class CoreTrace(Struct, kw_only=True):
    """The threads that had a core when a task missed a release."""

    task: str
    core: int
    traced: float
    """Seconds for which the core was followed."""
    missed: int = 0
    """Releases that were missed; 0: none in that time, and the next fields are void."""
    wall: float = 0.0
    """The last release with a cycle before them, seconds since 1970."""
    window: float = 0.0
    """Seconds from there to the next release with a cycle."""
    uses: list[CoreUse] = []
    """The threads that had the core meanwhile, longest first; empty with `fault`."""
    times: str = ""
    """The kernel's counts of the core while it was followed, as a sentence."""
    fault: str = ""
    """Why the kernel did not say which thread had it."""
