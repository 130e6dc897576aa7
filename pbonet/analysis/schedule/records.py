"""State of the real-time side as typed records.

The native core table (`_rt`) fills them; status displays, ``pbonet doctor``
and the recorder read them. Times are integer nanoseconds, instants of CLOCK_MONOTONIC.
"""

from __future__ import annotations

from enum import IntEnum

from msgspec import Struct


class Kind(IntEnum):
    """How a task is timed (Stewart 1994, section 3.8)."""

    PERIODIC = 0
    """Released by the dispatcher on an absolute grid."""
    SYNCHRONOUS = 1
    """Timed from outside: always ready, blocks in its own ``sync``."""
    DEFERRABLE = 2
    """A server whose capacity is whole at the begin of every period (6.5.2.1)."""
    SPORADIC = 3
    """A server that gets each piece of it back one period after its use (6.5.2.2)."""
    BACKGROUND = 4
    """A server without a capacity of its own."""


class Mode(IntEnum):
    """Requests of a task's slot to the dispatcher."""

    OFF = 0
    """No releases."""
    ON = 1
    """Releases on the grid; the task waits for them or runs a cycle."""
    COMMAND = 2
    """Releases continue, but the task is busy with a command and holds no level."""
    STANDS = 3
    """No releases; it waits to be engaged when others end."""


class Section(Struct, frozen=True):
    """A timed part of a task's cycle (section 6.7.2); CPU nanoseconds."""

    name: str
    count: int
    total_ns: int
    min_ns: int
    max_ns: int


class SlotStatus(Struct, frozen=True, kw_only=True):
    """One task's slot in the core table, read without touching the task.

    Totals run since the slot was allocated and are never reset. The ``on_`` fields hold
    their values at the last arming, so that "since turned on" is a subtraction.
    """

    index: int
    rtpu: str
    task: str
    pid: int
    kind: Kind
    mode: Mode
    dead: bool
    """The task's process is gone."""
    comes: bool
    """It stands by and is engaged, or one that hands over to it has ended."""
    called: bool
    """One that hands over to it has ended, and has called it."""
    fell: bool
    """It failed while it was ON: who stands by for it is engaged at once."""
    period_ns: int
    deadline_ns: int
    """Relative; 0 means the period."""
    crit: int
    priority: int
    level: int
    """SCHED_FIFO level held now; 0 when none."""
    errors: int
    """Calls about this task that the kernel refused."""

    now_ns: int
    """When this was read."""
    on_ns: int
    """When the task was armed last; 0 when it never was."""
    release_ns: int
    """The last release granted to the task."""
    cycles: int
    """Cycles run to their end, the commit included."""
    missed: int
    """Releases without a cycle of their own: overrun, overslept, or failed."""
    late: int
    """Cycles that ended after their deadline."""
    failed: int
    """Cycles in which the module raised or its outputs were refused."""
    stable_cycles: int
    """Cycles in which ``stable`` ran in place of ``cycle``."""
    on_cycles: int
    on_missed: int
    on_failed: int
    on_cpu_ns: int
    on_faults: int

    cpu_total_ns: int
    """CPU time of all cycles, the switch to and from the task included."""
    cpu_last_ns: int
    cpu_min_ns: int
    """Since armed, without the first cycle (section 6.7.1); 0 before the second."""
    cpu_max_ns: int
    restarted: bool
    """The two may lack cycles since the task was armed, as a restart was requested."""
    cpu_first_ns: int
    """Of the first cycle since armed, which is in no extreme."""
    cpu_now_ns: int
    """Of the cycle or event under way, up to now (the thesis's qc)."""
    wall_total_ns: int
    """Time from the begin to the end of all cycles."""
    held_ns: int
    """Time for which the dispatcher held the task so that others could run (`park`)."""
    copy_in_ns: int
    """Total time of copy-ins; divide by `cycles`."""
    copy_out_ns: int
    torn: int
    """Copy-ins that met the retry bound."""
    stale: int
    """Copy-ins that found a stale input."""
    faults: int
    """Minor page faults of the task's main thread within ``run``."""
    ring_lost: int
    """Records dropped because the ring was full."""
    jitter_max_ns: int
    jitter: list[int]
    """Delays from release to the call of ``cycle``: item 0 counts those below 1
    microsecond, item k those in [2**(k-1), 2**k) microseconds."""

    rank: int
    """The criticality that the task has at this moment."""
    drop: int
    """The one that it has once its reserve is used up."""
    handler: int
    """The one at which its failure handler runs; 0 for its own."""
    minc_ns: int
    maxc_ns: int
    """The reserve of each cycle, or of a server's period; 0 for none."""
    failures: tuple[int, ...]
    """Timing failures of kind deadline, maxexec and minexec (section 6.3)."""
    overruns: int
    """How often the reserve was used up."""
    held_off: int
    """Critical sections that lasted longer than they may, and were overruled."""
    aborted: int
    """Cycles that a failure handler ended."""
    skipped: int
    """Releases left out: too late to begin, or because a handler said so."""
    handlers: int
    """Calls of the module's failure handler."""
    uncalled_failures: int
    """Failures without a call of the handler: they came too late for their cycle, or
    while one of their kind still waited to be handled."""
    safe: int
    """Commits of safe values at a timing failure ..."""
    safe_last_ns: int
    safe_max_ns: int
    """... and how long after it they came."""
    safe_stands: bool
    """The cycle of the last one has not ended."""
    delivery_last_ns: int
    """From the finding of a failure to the begin of its handler."""
    delivery_max_ns: int
    hangs: bool
    """The task ended itself because its failure handler did not return."""
    hung: bool
    """Its cycle or `sync` does not return; until it does, all other tasks go first."""
    flooded: bool
    """Events come far more often than declared; `hung` is set, too."""
    in_sync: bool
    """It is timed by events, and is in `sync`."""
    sections: tuple[Section, ...]


class CoreStatus(Struct, frozen=True, kw_only=True):
    """The dispatcher of a core."""

    core: int
    backend: str
    """``fifo``, ``park``, or empty without a leader."""
    leader_pid: int
    """The RTPU process whose dispatcher leads; 0 when none does."""
    leader_tid: int
    since_ns: int
    """When the leader began to lead."""
    turns: int
    releases: int
    level_changes: int
    """Calls of sched_setscheduler made for tasks."""
    errors: int
    late_max_ns: int
    """Longest delay of a turn after the event it was to serve."""
    stalls: int
    """Turns that came more than 20 ms late: the core stood still, or was throttled."""
    stalled_ns: int
    """Their delays, added up."""
    stall_age_ns: int | None
    """Time since the last stall ended: 0 while one lasts, None if there was none."""
    takeovers: int
    """How often a standby took over from a leader that died."""
    spared: int
    """Checks of running cycles that were cancelled because none ran any more."""


class Histograms(Struct, frozen=True, kw_only=True):
    """Log-linear histograms of one task; `histogram` reads them."""

    jitter: list[int]
    cpu: list[int]


class Probe(Struct, frozen=True, kw_only=True):
    """Which real-time rights this process has, and why not more."""

    backend: str
    """``fifo`` or ``park``."""
    fifo: bool
    errno: int
    """The kernel's error number for SCHED_FIFO; 0 when it agreed."""
    reasons: list[str]
    """One sentence each: what is reduced, why, and what would help."""
    rtprio_limit: int
    """RLIMIT_RTPRIO; -1 means unlimited."""
    cap_sys_nice: bool
    cgroup_rt_runtime_us: int | None
    """Budget of the ``cpu`` cgroup; None where the kernel has no such file."""
    rt_runtime_us: int
    """/proc/sys/kernel/sched_rt_runtime_us; -1 means no throttling."""
    rt_period_us: int
    memlock_limit: int
    """Bytes; -1 means unlimited."""
    lock_memory: bool
    cores: list[int]
    """Cores this process may use."""
    share: float
    """Share of a core that real-time tasks are granted, above 0, at most 1."""
    share_reason: str
    """The reason of that limit, as a phrase."""
    preempt: str
    """The kernel's preemption model as far as it says."""


class Decision(Struct, frozen=True, array_like=True):
    """One record of the dispatcher's trace, explained in `dispatch`."""

    kind: int
    slot: int
    arg: int
    a: int
    b: int
