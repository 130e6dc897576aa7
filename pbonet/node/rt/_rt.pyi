"""Real-time side of a node: core table, dispatcher, task slot, ring, process set-up.

Nothing here depends on modules, commands or the network. See `docs/realtime.md`.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Final

from pbonet.analysis.schedule.records import (
    CoreStatus,
    Decision,
    Histograms,
    Probe,
    SlotStatus,
)
from pbonet.node.ring._ring import Record as Record, Ring as Ring, parse as parse
from pbonet.outside import Tape
from pbonet.svar._svar import Arena, LocalTable

# Results of `Slot.run`.
COMMAND: Final = 1
"""`CoreTable.request` was called; the request is cleared."""
ORPHAN: Final = 2
"""The parent is gone: run ``off`` and ``kill`` and end (last resort within 1 s)."""
FLAGS: Final = 3
"""A copy or commit raised a flag of the `leave` mask; see `Slot.flags`."""

ABORTED: Final = 4
"""The module's failure handler has ended the cycle; nothing was committed."""

LAST: Final = 5
"""That was the last cycle (`CoreTable.request` with `last`); the level is kept."""
ENGAGED: Final = 6
"""From `Slot.stand_by`: it is time to run ``on``."""
IDLE: Final = 7
"""In virtual time: nothing is due now."""
FALLBACK: Final = 1
HANDOVER: Final = 2
"""Kinds of events for `CoreTable.follow`; `pbonet.analysis.schedule.events.After`."""

FAIL_SIGNAL: Final[int]
KINDS: Final[tuple[str, ...]]
"""Kinds of timing failure, as `Slot.run` passes them to `failing`."""
CONTINUE: Final = 0
ABORT: Final = 1
SKIP: Final = 2
HANDLER_BOUND_NS: Final[int]
"""Time limit of a failure handler; after twice that time the process is ended."""

SLOTS: Final[int]
"""Number of tasks in one core table."""
MIN_PERIOD_NS: Final[int]
COMMAND_LEVEL: Final = 3
DISPATCHER_LEVEL: Final = 95
LEAVE: Final[int]
"""The default `leave` mask: all commit flags."""

class CoreTable:
    """The shared table of one core: ``pbonet.<uid>.core<k>`` in ``PBONET_SHM_DIR``.

    With `member` the process attaches as an RTPU process: the table is created if none
    exists or the existing one is stale, and is removed by the last member's `close`.
    Without it, an existing table is opened (tasks, agents, tools). With `virtual_ns`
    the table is private to this process; its time begins at that value and advances by
    `turn` and `grant`, and `core` is only a number.

    Raises:
        NodeError: There is no table to open, or it is damaged or of another version.
        RealTimeError: Shared memory is full, or the file belongs to another user.
    """

    core: int
    path: str
    member: bool
    def __init__(
        self, core: int, *, member: bool = True, virtual_ns: int = 0
    ) -> None: ...
    def close(self) -> None:
        """Detach; the last living member removes the file. Idempotent.

        Raises:
            NodeError: A dispatcher of this process still runs on it.
        """
    def alloc(self, rtpu: str, task: str) -> int:
        """Take a free slot; slots of dead RTPU processes are reclaimed first.

        Raises:
            NodeError: All slots are taken, or a name is longer than 63 bytes.
        """
    def free(self, i: int) -> None:
        """Free the slot; its task must be dead, or disarmed for good."""
    def configure(
        self,
        i: int,
        *,
        pid: int | None = None,
        period_ns: int | None = None,
        deadline_ns: int | None = None,
        crit: int | None = None,
        priority: int | None = None,
        kind: int | None = None,
        minc_ns: int | None = None,
        maxc_ns: int | None = None,
        hang_ns: int | None = None,
        drop: int | None = None,
        handler: int | None = None,
        tells: bool | None = None,
        safe_at: Collection[str] = (),
    ) -> None:
        """Change the given settings; the dispatcher applies them all in one turn.

        A new period takes effect at the next release, everything else at once.

        Args:
            i: The slot.
            pid: The task's process; its main thread is scheduled.
            period_ns: At least MIN_PERIOD_NS.
            deadline_ns: Relative to the release; 0 means the period.
            crit: Criticality 0 to 63, higher first.
            priority: User priority 0 to 65535, higher first.
            kind: A `pbonet.analysis.schedule.records.Kind`.
            minc_ns: CPU time guaranteed to each cycle; 0 for none.
            maxc_ns: CPU time reserved for each cycle, or for a server's period; 0 for
                no limit.
            hang_ns: CPU time after which a cycle that has used up its period hangs.
            drop: Criticality once the reserve is used up.
            handler: Criticality of the module's failure handler; 0 for the task's own.
            tells: The module has a failure handler.
            safe_at: With `tells`: the kinds of failure, of KINDS, at which the
                out-vars get their safe values.

        Raises:
            ValueError: A value is out of its range.
        """
    def request(self, i: int, *, last: bool = False) -> None:
        """Notify the task that a command waits for it, and wake it if it sleeps.

        With `last` the task returns from `Slot.run` after its next cycle, and keeps
        that cycle's level.
        """
    def restart_extremes(self, i: int) -> None:
        """Ask the task to let its extremes of CPU time begin with its next cycle."""
    def follow(self, i: int, slots: Collection[int]) -> None:
        """Engage a standby when one of these slots falls.

        Args:
            i: The standby's slot.
            slots: The slots that it is the fallback of; empty: it waits for no slot and
                for no callers.
        """
    def expect(self, i: int, ticket: int, callers: int) -> int:
        """Engage a standby when all its predecessors have called.

        Args:
            i: The standby's slot.
            ticket: A number not used by an earlier wait, from 1 to 2**31 - 1.
            callers: Number of predecessors, up to 32.

        Returns:
            The slot's life, which callers need.
        """
    def expects(self, i: int, life: int, ticket: int, caller: int) -> bool:
        """Return whether a slot waits for that caller, counted from 0."""
    def call(self, i: int, life: int, ticket: int, caller: int) -> bool:
        """Record that a caller has ended; return whether it was expected."""
    def died(self, i: int) -> None:
        """Report to the dispatcher that the task's process is gone."""
    def relevel(self) -> None:
        """Ask the dispatcher to set the levels of all tasks again."""
    def kick(self) -> None:
        """Have the dispatcher take a turn now."""
    def reap(self) -> None:
        """Free the slots of other RTPUs that ended together with their tasks."""
    def find(self, rtpu: str, task: str) -> int | None:
        """Return the slot of that name."""
    def slots(self, rtpu: str | None = None) -> list[int]:
        """Return the slots in use, of one RTPU or of all."""
    def snapshot(self, i: int) -> SlotStatus: ...
    def signals(self, i: int) -> tuple[int, ...]:
        """Return how often the task has sent each signal that was not masked."""
    def mask_signals(self, i: int, bits: int) -> None:
        """Set which signals of the task are ignored, as bits of `pbonet.Signal`."""
    def histograms(self, i: int) -> Histograms: ...
    def status(self) -> CoreStatus: ...
    def cpu_ns(self) -> int:
        """Return the CPU time of the leader's dispatcher and timer threads."""
    def members(self) -> list[tuple[int, bool]]:
        """Return the attached RTPU processes: pid, and whether it is alive."""
    def trace(self, since: int = 0) -> tuple[int, int, list[Decision]]:
        """Return records of complete turns from number `since` on.

        Returns:
            The number to pass next, how many records were overwritten, and the records.
        """
    def step(self, now_ns: int, *, park: bool = False, lead: bool = False) -> int:
        """Take one turn in virtual time without acting on it; for tests.

        Args:
            now_ns: The time.
            park: Let only the most urgent task run.
            lead: Take it as the first turn of a new leader.

        Returns:
            The time of the next event; 0 if there is none.

        Raises:
            RealTimeError: A dispatcher leads the table.
        """
    virtual_ns: int
    """The current time if it is virtual; else 0."""
    @property
    def due_ns(self) -> int:
        """The time of the next turn in virtual time; 0 if there is none."""
    def turn(self, now_ns: int) -> int:
        """Take one turn in virtual time, under ``park``.

        Returns:
            The slot of the task that may run, -1 for none; call again when the
            task's cycle has ended.

        Raises:
            RealTimeError: A dispatcher leads the table.
        """
    def grant(self, i: int, now_ns: int, *, periodic: bool = True) -> None:
        """Grant a task one cycle at this virtual time, without a turn.

        Args:
            i: The slot.
            now_ns: The virtual time.
            periodic: Whether the task has a period, which is the `dt` of its first
                cycle.
        """
    def post(
        self,
        i: int,
        *,
        mode: int | None = None,
        begun: bool = False,
        done: bool = False,
        event: int | None = None,
        locked: bool | None = None,
        handled: bool = False,
        fell: bool = False,
        wish: tuple[int, int] | None = None,
        cpu_ns: int = 0,
    ) -> None:
        """Act as the task in virtual time; for tests, refused like `step`."""

class Dispatcher:
    """A native thread that leads the core or stands by for the leader.

    It never takes the GIL. `backend` is ``auto``, ``fifo`` or ``park``; ``auto``
    selects ``fifo`` if `probe` finds that the process may use it.

    Raises:
        RealTimeError: ``fifo`` was requested and is refused.
    """

    table: CoreTable
    def __init__(self, table: CoreTable, backend: str = "auto") -> None: ...
    def start(self) -> None: ...
    def keep_values(self, i: int, arena: Arena, values: bytes) -> None:
        """Commit these values when a cycle of the task in slot `i` fails in time.

        They are laid out as `svar.LocalTable.keep_safe` returns them. Which failures is
        said by `CoreTable.configure`.
        """
    def drop_values(self, i: int) -> None:
        """Forget them, at the latest when the slot is freed. Idempotent."""
    def stop(self) -> None:
        """End the thread; a standby takes over. Idempotent."""
    @property
    def leading(self) -> bool: ...
    @property
    def backend(self) -> str:
        """``fifo`` or ``park``."""
    @property
    def running(self) -> bool: ...

class Vigil:
    """A native thread that detects tasks' deaths and errors at once.

    It notifies the dispatcher and raises the illegal-configuration flag, without the
    GIL.

    Raises:
        RealTimeError: The thread cannot be started.
    """

    def __init__(self, beside: Dispatcher) -> None: ...
    def watch(
        self, i: int, arena: Arena | None, raiser: bytes, died: bytes, fell: bytes
    ) -> None:
        """Watch the task of slot `i`, which has called `Slot.vow`.

        Args:
            i: The slot.
            arena: The table whose flag is raised; None: no flag.
            raiser: Name of the flag entry's raiser, as UTF-8.
            died: The cause if the task dies while it is armed.
            fell: The cause if it goes to ERROR.
        """
    def forget(self, i: int) -> None:
        """Stop watching the slot; harmless if it is not watched."""
    @property
    def counts(self) -> tuple[int, int]:
        """Deaths and errors that the thread has detected."""
    def stop(self) -> None:
        """End the thread. Idempotent."""

class Failures:
    """Messages between the dispatcher and a module during a cycle."""

    criticality: int
    deadline: float
    """Seconds from the release; setting it moves the deadline of this cycle."""
    @property
    def returned(self) -> str:
        """The method in C that has just returned, while its failures are handled."""
    @property
    def own_criticality(self) -> int:
        """The task's configured criticality, whatever this cycle has changed."""
    @property
    def error(self) -> BaseException | None:
        """The exception of the failure handler in the last `Slot.run`."""
    @property
    def section(self) -> AbstractContextManager[None]:
        """A context manager that defers failures; it can be nested."""
    def timed(self, name: str) -> AbstractContextManager[None]:
        """Return a context manager that measures a section in CPU time.

        Raises:
            ValueError: The task has no room for another section.
        """

class Slot:
    """The task's side of its slot; made once, in the main thread of its process."""

    index: int
    failures: Failures
    action: int
    """The `pbonet.svar.Action` that ran last in place of `cycle`; 0: `cycle` ran."""
    tape: Tape | None
    """The module's inputs from outside the table, stored in each record."""
    stamp_ns: int
    """Measurement time of the outputs to be committed; 0: the time of the commit."""
    def __init__(self, table: CoreTable, i: int) -> None: ...
    def run(
        self,
        cycle: Callable[[float], object],
        local: LocalTable | None,
        *,
        stable: Callable[[float], object] | None = None,
        safe: Callable[[float], object] | None = None,
        critical: int = 0,
        sync: Callable[[], object] | None = None,
        ring: Ring | None = None,
        leave: int = ...,
        failing: Callable[[str], int] | None = None,
        aged: Callable[[bool], object] | None = None,
    ) -> int:
        """Run cycles until something else must be done.

        Per release: copy in, ``cycle(dt)`` (or what `critical` says while the
        illegal-configuration flag is up, or the local table's action while inputs are
        too old), commit, account, record. Arms the slot when
        it is not armed; on return the slot stays armed, and the task runs at
        COMMAND_LEVEL until it calls `run` again or `disarm`. An exception of the
        module propagates; the cycle then counts as failed and nothing is committed.

        Args:
            cycle: Called with the seconds between this release and that of the last
                executed cycle.
            local: The local table to copy in and out; None copies nothing.
            stable: Runs for `pbonet.svar.Action.STABLE`.
            safe: Runs for ``SAFE``.
            critical: The action while the flag is up; 0: `cycle` runs.
            sync: Blocks until the next event of a task that is not periodic; required
                for such tasks.
            ring: Gets one record per cycle.
            leave: Flags of copy-in and commit on which to return FLAGS.
            failing: Called during the cycle with one of `KINDS` when the dispatcher has
                found a timing failure; returns CONTINUE, ABORT or SKIP. An exception
                that it raises ends the cycle and propagates.
            aged: Called when inputs have become too old, and when they have been fresh
                for long enough.

        Returns:
            COMMAND, ORPHAN, FLAGS, ABORTED or LAST; in virtual time IDLE.
        """
    def stand_by(self) -> int:
        """Wait while OFF until the dispatcher engages the task.

        Returns:
            ENGAGED: run ``on`` at the level that the task was given, then `arm`.
            COMMAND, ORPHAN: the task is no longer a standby.
            IDLE: in virtual time; it stands by until `CoreTable.turn` lets it run.
        """
    def arm(self) -> None:
        """Ask for releases, as `run` does."""
    def fall(self) -> None:
        """Go to ERROR: as `disarm`, and the task's standby is engaged."""
    def vow(self) -> None:
        """Let a `Vigil` detect the task's death from here on.

        Raises:
            RealTimeError: Another process holds the slot's lock.
        """
    def disarm(
        self, calls: Iterable[tuple[CoreTable, int, int, int, int]] = ()
    ) -> list[bool]:
        """Stop releases until `run` arms the slot again. Idempotent.

        Args:
            calls: The successors to call: for each, its core table and the arguments
                of `CoreTable.call`.

        Returns:
            For each successor whether it waited for this task.
        """
    def command_level(self) -> None:
        """Go to the level of commands (after ``init``); no effect under ``park``."""
    def meet_dispatcher(self) -> None:
        """Take hold of the timer of the dispatcher's checks, before rights are dropped.

        A task that has it stops a check when its cycle has ended, and may release
        itself while no other one of its core is ready. Otherwise the dispatcher does
        both.
        """
    def signal(self, bits: int) -> int:
        """Count the signals that are not masked, and return them; never waits."""
    @property
    def sigmask(self) -> int:
        """Signals of this task that are ignored."""
    @property
    def armed(self) -> bool: ...
    @property
    def after(self) -> int:
        """`FALLBACK` or `HANDOVER`: what engages the task; 0: nothing."""
    @property
    def safe(self) -> bool:
        """Whether the last cycle of `run` failed in time and its out-vars are safe."""
    @property
    def flags(self) -> int:
        """Flags of the last copy-in and commit."""
    @property
    def stable(self) -> bool:
        """Whether `stable` runs in place of `cycle`, or ran last."""
    @property
    def now_ns(self) -> int:
        """The current time of the task: CLOCK_MONOTONIC, or virtual."""
    @property
    def release_ns(self) -> int:
        """The release of the current cycle, or of the last one."""
    @property
    def cycles(self) -> int: ...
    @property
    def missed(self) -> int: ...
    @property
    def period_ns(self) -> int: ...
    @property
    def pending(self) -> bool:
        """Whether a command waits (for a module that works in steps)."""

def probe() -> Probe:
    """Return this process's real-time rights, with reasons, by trying them."""

def orphan_guard(signal: int, parent: int = 0) -> int:
    """End within 1 s when the parent process ends.

    The kernel sends `signal` when the parent dies. Its handler is native: it flags
    and wakes the slot, makes the returned descriptor readable, and arms ``alarm(1)``
    with the default action as the last resort.

    Args:
        signal: A signal not used otherwise, for instance SIGUSR1.
        parent: The parent's pid as known before the fork; if it has already ended,
            the guard fires at once. 0: not checked.

    Returns:
        A descriptor that is readable once orphaned.
    """

def orphaned() -> bool: ...
def leave_to_next(signal: int) -> None:
    """Leave a signal to the program that is about to replace this one.

    Any thread that receives it redirects it to the main thread, which must have blocked
    it: there it stays pending until the next program unblocks it.

    Raises:
        RealTimeError: The signal cannot have a handler, for example SIGKILL.
    """

def lock_memory() -> None:
    """Lock present and future pages when they are first touched.

    Raises:
        RealTimeError: The memlock limit is too small to do this safely.
    """

def restrict(pids: Sequence[int]) -> None:
    """Refuse this thread calls with which a module could harm others; for good.

    Refused, with EPERM, are changes of priority and core other than the node's own, and
    signals to some processes. Threads and processes that it starts inherit this, and
    programs that it starts get no rights by ``setuid``.

    Args:
        pids: At most 8 arguments of ``kill``: processes, groups (negative), -1 for all.

    Raises:
        RealTimeError: The kernel has no seccomp filters for this machine.
    """

def drop_rights() -> None:
    """Give up capabilities that reach beyond a module's own devices and files.

    Kept are those for devices, network and files of others. Priorities above that of
    commands cannot be requested any more, if the dispatcher may still set them.

    Raises:
        RealTimeError: The kernel refuses.
    """

def prefault_stack(size: int = 1 << 19) -> None: ...
def populate_pages(
    copied: Iterable[tuple[int, int]] = (), spare: int = 1 << 20, whole: int = 1 << 24
) -> int:
    """Make private writable pages present that are not: what `init` has allocated.

    Pages that are shared with the fork server stay so until they are written: most of
    them are code and descriptions of Python's objects, which no cycle touches.

    Args:
        copied: Where shared pages begin and end that are copied now.
        spare: Bytes of the heap that are free for the temporaries of cycles.
        whole: Bytes. Larger areas are left alone: such are buffers of which little is
            used. OpenBLAS has one of 32 MB in each process.

    Returns:
        Bytes that were made present, without the copied ones.

    Raises:
        MemoryError: The heap cannot have so many spare bytes.
    """

def see_interrupt(signal: int) -> None:
    """Have a signal seen that comes amid a cycle in C, where no bytecode runs.

    Args:
        signal: One that has a handler in Python.

    Raises:
        RealTimeError: It has none.
    """

def set_timer_slack(ns: int = 1) -> None: ...
def pin(core: int) -> None:
    """Pin the calling thread to a core.

    Raises:
        RealTimeError: The core does not exist or may not be used.
    """

def monotonic_ns() -> int: ...
def thread_cpu_ns() -> int: ...
