"""Real-time side of a node: core table, dispatcher, task slot, ring, process set-up.

Nothing here knows modules, commands or the network. `docs/realtime.md` explains it.
"""

from collections.abc import Callable, Collection, Iterable
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

# Why `Slot.run` came back.
COMMAND: Final = 1
"""`CoreTable.request` was called; the flag is cleared."""
ORPHAN: Final = 2
"""The parent is gone: run ``off`` and ``kill`` and end (last resort within 1 s)."""
FLAGS: Final = 3
"""A copy or commit raised a flag of the `leave` mask; see `Slot.flags`."""

ABORTED: Final = 4
"""The module's failure handler has ended the cycle; nothing was committed."""

LAST: Final = 5
"""That was to be the last cycle: `CoreTable.request` with `last`; the level is kept."""
ENGAGED: Final = 6
"""From `Slot.stand_by`: it is time to run ``on``."""
IDLE: Final = 7
"""In virtual time: there is nothing to do at this instant."""
FALLBACK: Final = 1
HANDOVER: Final = 2
"""Kinds of events for `CoreTable.follow`; `pbonet.analysis.schedule.events.After`."""

FAIL_SIGNAL: Final[int]
KINDS: Final[tuple[str, ...]]
"""Kinds of timing failure, as `Slot.run` hands them to `failing`."""
CONTINUE: Final = 0
ABORT: Final = 1
SKIP: Final = 2
HANDLER_BOUND_NS: Final[int]
"""A failure handler may take so long; as long again, and the process is ended."""

SLOTS: Final[int]
"""Tasks that one core table holds."""
MIN_PERIOD_NS: Final[int]
COMMAND_LEVEL: Final = 3
DISPATCHER_LEVEL: Final = 95
LEAVE: Final[int]
"""The default `leave` mask: all commit flags."""

class CoreTable:
    """The shared table of one core: ``pbonet.<uid>.core<k>`` in ``PBONET_SHM_DIR``.

    With `member` the process attaches as an RTPU process: the table is created when
    there is none or when the one found is stale, and is removed by the last member's
    `close`. Without, an existing table is opened (tasks, agents, tools). With
    `virtual_ns` it is a table of this process alone, whose time begins there and
    passes by `turn` and `grant`; `core` is only a number then.

    Raises:
        NodeError: No table to open, or it is of another version or damaged.
        RealTimeError: Shared memory is full, or the file belongs to somebody else.
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
        """Give the slot back; its task must be dead, or disarmed for good."""
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
        drop: int | None = None,
        handler: int | None = None,
        tells: bool | None = None,
    ) -> None:
        """Change what is given; the dispatcher takes the whole change in one turn.

        A new period takes effect at the next release, the rest at once.

        Args:
            i: The slot.
            pid: The task's process; its main thread is scheduled.
            period_ns: At least MIN_PERIOD_NS.
            deadline_ns: Relative to the release; 0 means the period.
            crit: Criticality 0 to 63, higher first.
            priority: User priority 0 to 65535, higher first.
            kind: A `pbonet.analysis.schedule.records.Kind`.
            minc_ns: The least CPU time of a cycle; 0 for none.
            maxc_ns: CPU time reserved for each cycle, or for a server's period; 0 for
                as much as it takes.
            drop: Criticality once that is used up.
            handler: Criticality of the module's failure handler; 0 for the task's own.
            tells: The module has a failure handler.

        Raises:
            ValueError: A value is out of its range.
        """
    def request(self, i: int, *, last: bool = False) -> None:
        """Tell the task that a command waits for it, waking it when it waits.

        With `last` it looks behind its next cycle, and comes back at the level of that.
        """
    def follow(self, i: int, slots: Collection[int]) -> None:
        """Have a task that stands by engaged when one of these slots falls.

        Args:
            i: The slot that stands by.
            slots: Those that it is the fallback of; none: it waits for nothing, and for
                no callers either.
        """
    def expect(self, i: int, ticket: int, callers: int) -> int:
        """Have a task that stands by engaged when all who hand over to it have called.

        Args:
            i: The slot that stands by.
            ticket: A number that no other wait has had, from 1 to 2**31 - 1.
            callers: How many they are, up to 32.

        Returns:
            The slot's life, without which nobody can call.
        """
    def expects(self, i: int, life: int, ticket: int, caller: int) -> bool:
        """Tell whether a slot waits for that caller, counted from 0."""
    def call(self, i: int, life: int, ticket: int, caller: int) -> bool:
        """Say that a caller has ended; return whether it was waited for."""
    def died(self, i: int) -> None:
        """Tell the dispatcher that the task's process is gone."""
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
        """Say which signals nobody wants of the task, as bits of `pbonet.Signal`."""
    def histograms(self, i: int) -> Histograms: ...
    def status(self) -> CoreStatus: ...
    def cpu_ns(self) -> int:
        """Return the CPU time of the leader's dispatcher and its thread that looks."""
    def members(self) -> list[tuple[int, bool]]:
        """Return the RTPU processes attached: pid, and whether it lives."""
    def trace(self, since: int = 0) -> tuple[int, int, list[Decision]]:
        """Return records of complete turns from number `since` on.

        Returns:
            The number to ask for next, how many records were lost to the ring's bound,
            and the records.
        """
    def step(self, now_ns: int, *, park: bool = False) -> int:
        """Take one turn in virtual time and act on nothing; for tests.

        Returns:
            The instant of the next event; 0 when there is none.

        Raises:
            RealTimeError: A dispatcher leads the table.
        """
    virtual_ns: int
    """The time, where it is virtual; else 0."""
    @property
    def due_ns(self) -> int:
        """The instant of the next turn in virtual time; 0 when there is none."""
    def turn(self, now_ns: int) -> int:
        """Take one turn in virtual time, under ``park``.

        Returns:
            The slot of the task that is let run, -1 for none; call it again when the
            task's cycle has ended.

        Raises:
            RealTimeError: A dispatcher leads the table.
        """
    def grant(self, i: int, now_ns: int, *, periodic: bool = True) -> None:
        """Grant a task one cycle at this instant of virtual time, without a turn.

        Args:
            i: The slot.
            now_ns: The instant.
            periodic: Whether the task has a period, by which its first cycle steps.
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
        """Play the task's part in virtual time; for tests, refused like `step`."""

class Dispatcher:
    """A native thread that leads the core or stands by for the leader.

    It never takes the GIL. `backend` is ``auto``, ``fifo`` or ``park``; ``auto`` takes
    ``fifo`` when `probe` finds the right to it.

    Raises:
        RealTimeError: ``fifo`` was asked for and is refused.
    """

    def __init__(self, table: CoreTable, backend: str = "auto") -> None: ...
    def start(self) -> None: ...
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
    """A native thread that hears of tasks' deaths and errors at once.

    It tells the dispatcher, and raises the illegal-configuration flag, without the GIL.

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
            arena: The table whose flag is raised; None raises none.
            raiser: Whose entry that is, as UTF-8.
            died: The cause when it dies while it is armed.
            fell: The cause when it goes to ERROR.
        """
    def forget(self, i: int) -> None:
        """Watch the slot no longer; harmless when nobody does."""
    @property
    def counts(self) -> tuple[int, int]:
        """Deaths and errors that it was the first to know of."""
    def stop(self) -> None:
        """End the thread. Idempotent."""

class Failures:
    """Messages between the dispatcher and a module within a cycle."""

    criticality: int
    deadline: float
    """Seconds from the release; setting it moves the deadline of this cycle."""
    @property
    def own_criticality(self) -> int:
        """The task's own criticality, whatever it was changed to in this cycle."""
    @property
    def error(self) -> BaseException | None:
        """The exception of the failure handler in the last `Slot.run`."""
    @property
    def section(self) -> AbstractContextManager[None]:
        """Holds failures off while it is entered; nests."""
    def timed(self, name: str) -> AbstractContextManager[None]:
        """Return what times a section in CPU time.

        Raises:
            ValueError: There is no room for one more.
        """

class Slot:
    """The task's own end of its slot; made once in the task's process, main thread."""

    index: int
    failures: Failures
    tape: Tape | None
    """The module's inputs from outside the table; each record carries them."""
    stamp_ns: int
    """When the outputs that are committed were measured; 0: at the commit."""
    def __init__(self, table: CoreTable, i: int) -> None: ...
    def run(
        self,
        cycle: Callable[[float], object],
        local: LocalTable | None,
        *,
        stable: Callable[[float], object] | None = None,
        sync: Callable[[], object] | None = None,
        ring: Ring | None = None,
        leave: int = ...,
        failing: Callable[[str], int] | None = None,
        aged: Callable[[bool], object] | None = None,
    ) -> int:
        """Run cycles until there is something else to do.

        Per release: copy in, ``cycle(dt)`` (or ``stable(dt)`` while the
        illegal-configuration flag is up), commit, account, record. Arms the slot when
        it is not armed; on return the slot stays armed, and the task runs at
        COMMAND_LEVEL until it calls `run` again or `disarm`. An exception of the
        module comes through, the cycle then counts as failed and nothing is committed.

        Args:
            cycle: Called with the seconds between this release and that of the last
                executed cycle.
            local: Where to copy from and to; None does no copying.
            stable: Runs in place of `cycle` while the flag is up.
            sync: What a task that is timed from outside blocks in, in place of a
                release.
            ring: Gets one record a cycle.
            leave: Flags of copy-in and commit on which to return FLAGS.
            failing: Called amid the cycle with one of `KINDS` when the dispatcher has
                found a timing failure; answers CONTINUE, ABORT or SKIP. What it raises
                ends the cycle and comes through.
            aged: Called when inputs have become stale, and when they are fresh again.
                While they are stale `stable` runs.

        Returns:
            COMMAND, ORPHAN, FLAGS, ABORTED or LAST; in virtual time IDLE.
        """
    def stand_by(self) -> int:
        """Wait, OFF, until the dispatcher engages the task; see `CoreTable.follow`.

        Returns:
            ENGAGED: run ``on`` at the level that the task was given, then `arm`.
            COMMAND, ORPHAN: the task does not stand by any more.
            IDLE: in virtual time; it stands by until `CoreTable.turn` lets it run.
        """
    def arm(self) -> None:
        """Ask for releases, as `run` does."""
    def fall(self) -> None:
        """Be in ERROR: as `disarm`, and whoever stands by for the task is engaged."""
    def vow(self) -> None:
        """Have the task's death known at once, from here on (`Vigil`).

        Raises:
            RealTimeError: Another process holds the slot's lock.
        """
    def disarm(
        self, calls: Iterable[tuple[CoreTable, int, int, int, int]] = ()
    ) -> list[bool]:
        """No more releases, until `run` arms again. Idempotent.

        Args:
            calls: Successors that are engaged by that: of each the core table, and the
                arguments of `CoreTable.call`.

        Returns:
            Which of them waited for it.
        """
    def command_level(self) -> None:
        """Go to the level of commands (after ``init``); nothing under ``park``."""
    def signal(self, bits: int) -> int:
        """Count the signals that are not masked, and return them; never waits."""
    @property
    def sigmask(self) -> int:
        """Signals that nobody wants of this task."""
    @property
    def armed(self) -> bool: ...
    @property
    def after(self) -> int:
        """`FALLBACK` or `HANDOVER`: why the task is engaged; 0: nobody waits for it."""
    @property
    def flags(self) -> int:
        """Flags of the last copy-in and commit."""
    @property
    def stable(self) -> bool:
        """Whether `stable` runs in place of `cycle`, or ran last."""
    @property
    def now_ns(self) -> int:
        """The time in which the task lives: CLOCK_MONOTONIC, or virtual."""
    @property
    def release_ns(self) -> int:
        """The release of the cycle that runs, or ran last."""
    @property
    def cycles(self) -> int: ...
    @property
    def missed(self) -> int: ...
    @property
    def period_ns(self) -> int: ...
    @property
    def pending(self) -> bool:
        """A command waits (for a module that works in pieces)."""

def probe() -> Probe:
    """Return which real-time rights this process has, with reasons; tries for real."""

def orphan_guard(signal: int, parent: int = 0) -> int:
    """End within 1 s when the parent process ends.

    The kernel sends `signal` when the parent dies. Its handler is native: it flags
    and wakes the slot, makes the returned descriptor readable, and arms ``alarm(1)``
    with the default action as the last resort.

    Args:
        signal: A signal not used otherwise, for instance SIGUSR1.
        parent: The parent's pid as known before the fork; when it is gone already, the
            guard fires at once. 0: not checked.

    Returns:
        A descriptor that is readable once orphaned.
    """

def orphaned() -> bool: ...
def leave_to_next(signal: int) -> None:
    """Leave a signal to the program that is about to take this one's place.

    Whichever thread takes it hands it to the main thread, which must have blocked it:
    there it is pending until the next program unblocks it.

    Raises:
        RealTimeError: It has no handler, as SIGKILL.
    """

def lock_memory() -> None:
    """Lock present and future pages as they are touched.

    Raises:
        RealTimeError: The memlock limit is too small for it to be safe.
    """

def prefault_stack(size: int = 1 << 19) -> None: ...
def populate_pages() -> int:
    """Make every private writable page present, undoing fork's sharing.

    Returns:
        Bytes populated.
    """

def set_timer_slack(ns: int = 1) -> None: ...
def pin(core: int) -> None:
    """Pin the calling thread to a core.

    Raises:
        RealTimeError: The core does not exist or may not be used.
    """

def monotonic_ns() -> int: ...
def thread_cpu_ns() -> int: ...
