"""The end of a run of a job: its outcome, and the signals that end it."""

from __future__ import annotations

import _thread  # noqa: PLC2701 - a thread is begun without a lock, in a handler
import contextlib
import signal
import threading
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from pbonet.errors import PbonetError
from pbonet.master.subsystem import SequenceState

from . import summary

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Generator, Iterable, Mapping
    from types import FrameType

    from pbonet.log import Cycles, Log
    from pbonet.xm.net import RtpuStatus

MOST_READ: Final = 32 << 20
"""Bytes of a log up to which it is read at the end: some tenths of a second."""
_FORCE: Final = 2
"""At this many interrupts everything is stopped at once."""


class Status(IntEnum):
    """Exit statuses of a run that ended without a fault, but not as it should."""

    UNRECORDED = 3
    STOOD_STILL = 4
    STOPPED = 5


class Shortfall(Struct, frozen=True):
    """One thing that a run did not do as it should, though nothing failed."""

    status: Status
    """The exit status of a strict run."""
    text: str


class Outcome(Struct, kw_only=True):
    """How a run went."""

    job: str
    """The name of the job, or of the sequence."""
    seconds: float
    tasks: list[summary.TaskSummary]
    reason: str
    """Why it ended."""
    faults: list[str] = []
    """Faults at the end."""
    shortfalls: list[Shortfall] = []
    """Results that are less than they should be, without a fault."""
    strict: bool = False
    """Whether these have exit statuses."""
    log: str = ""
    """The run's folder, with its log; empty when nothing was recorded here."""
    recording: Cycles | None = None
    """The same, to be read."""
    unlogged: dict[str, int] = {}
    """The number of records that each RTPU's recorder had lost by its last status."""
    sequence: SequenceState | None = None
    """How the sequence has ended; None: it was a job."""

    @property
    def status(self) -> int:
        """The exit status: 1 when a task ended in ERROR or something was left."""
        if self.faults or any(task.error for task in self.tasks):
            return 1
        if not self.strict:
            return 0
        return min((one.status for one in self.shortfalls), default=0)

    def log_line(self) -> str:
        """Return what stands in the log, and where it is."""
        what = "every cycle"
        if self.recording is not None and self.recording.only_last:
            what = "what came before each error"
        if any(one.status == Status.UNRECORDED for one in self.shortfalls):
            what = "what was recorded"
        return f"{what} is in {self.log}"

    def last_line(self) -> str:
        """Return what a run that has not failed lacks; empty if nothing."""
        texts = "; ".join(one.text for one in self.shortfalls)
        if texts and self.strict and self.status != 1:
            return f"ERROR> exit status {self.status:d} (--strict): {texts}"
        return f"WARNING> {texts}" if texts else ""


def is_read(log: Log) -> bool:
    """Return whether a log is short enough to be read at the end of its run."""
    return log.size <= MOST_READ


def unrecorded(
    log: Log | None,
    planned: Iterable[str],
    recorded: Container[str],
    unlogged: Mapping[str, int] | None = None,
) -> str:
    """Return what a run's recording lacks, in one sentence; empty if nothing.

    Args:
        log: The log on this machine, None if there is none.
        planned: The RTPUs that should have recorded.
        recorded: Those that did.
        unlogged: The number of records that each RTPU's recorder had lost by its last
            status. It counts where a log is not read: it is long, or elsewhere.
    """
    absent = [rtpu for rtpu in planned if rtpu not in recorded]
    lacks = [f"nothing of {', '.join(absent)}"] if absent else []
    read: set[str] = set()
    if log is not None and is_read(log):
        read = {part.about.rtpu for part in log.parts if part.about is not None}
        lost = log.lost()
        lacks += [f"{count} cycles of {task}" for task, count in lost.items() if count]
        damage = len(log.check())
        lacks += [f"{damage} damaged parts of the log"] if damage else []
    for rtpu, count in (unlogged or {}).items():
        if count and rtpu not in read:
            lacks.append(f"{count} cycles of {rtpu}")
    if log is not None and not log.complete:
        lacks.append("the end of the log")
    return f"not recorded: {', '.join(lacks)}" if lacks else ""


class Standstills:
    """Standstills of the machine during a run, from the status of its RTPUs."""

    def __init__(self) -> None:
        self._begin: dict[str, RtpuStatus] = {}
        self._last: dict[str, RtpuStatus] = {}

    def update(self, rtpus: Iterable[RtpuStatus]) -> None:
        """Note the present counts; the first ones are those at the beginning."""
        for rtpu in rtpus:
            before = self._last.get(rtpu.rtpu)
            if before is None or rtpu.stalls < before.stalls:  # its process is new
                self._begin[rtpu.rtpu] = rtpu
            self._last[rtpu.rtpu] = rtpu

    def text(self, tasks: Iterable[summary.TaskSummary]) -> str:
        """Return which RTPUs stood still and lost cycles; empty if none did."""
        missed: dict[str, int] = {}
        for task in tasks:
            missed[task.rtpu] = missed.get(task.rtpu, 0) + task.missed
        found: list[str] = []
        for name, last in self._last.items():
            count = last.stalls - self._begin[name].stalls
            lasted = last.stalled - self._begin[name].stalled
            if count and missed.get(name):
                times = "once" if count == 1 else f"{count} times"
                found.append(
                    f"the machine of {name} stood still {times}, {lasted:.2g} s in "
                    f"all; its tasks missed {missed[name]} releases in this run"
                )
        return "; ".join(found)


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupts:
    """Turn SIGINT, SIGTERM and SIGHUP into a request to end; a second stops at once.

    Args:
        once: A second one acts as if signals were not caught, which ends a module that
            hangs in this very process.
        ends: What the first one begins, for its message.
        say: Shows what an interrupt does; None: nothing is shown.
    """

    def __init__(
        self,
        *,
        once: bool = False,
        ends: str = "",
        say: Callable[[str], object] | None = None,
    ) -> None:
        self.wished = threading.Event()
        self.count = 0
        self._once = once
        self._ends = ends
        self._say = say
        self._before: dict[signal.Signals, Any] = {}
        self.force: Callable[[], object] | None = None
        """Called, once, in a thread of its own after the second interrupt."""
        self.awaited: Callable[[], str] = str
        """Returns what is waited for, for the message of further ones."""

    def take(self, _number: int, _frame: FrameType | None) -> None:
        """Take a signal.

        What it does is done by another thread: the main one may hold the lock of the
        event just now, because it waits for it, and would wait for itself.
        """
        self.count += 1
        _thread.start_new_thread(self._taken, (self.count,))
        if self._once:
            self._give_back()

    def _taken(self, count: int) -> None:
        """Request the end, or have everything stopped at once; say which."""
        self.wished.set()
        if count < _FORCE:
            self._show(f"interrupted: {self._ends}")
            return
        force, self.force = self.force, None
        if force is None:
            awaited = self.awaited()
            waits = f"waits for {awaited}" if awaited else "its steps have time limits"
            self._show(f"interrupted again: the end is under way; {waits}")
            return
        self._show("interrupted again: everything is stopped at once")
        with contextlib.suppress(PbonetError):  # the end of the run shows what failed
            force()

    def _show(self, text: str) -> None:
        """Show a line; if its pipe was closed, nothing, and what follows is done."""
        if self._say is not None:
            with contextlib.suppress(OSError, SystemExit):  # the latter is rich's
                self._say(text)

    @contextlib.contextmanager
    def caught(self) -> Generator[None]:
        """Catch the signals, in the main thread; elsewhere they are its matter."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        for one in _SIGNALS:
            if one != signal.SIGHUP or signal.getsignal(one) is not signal.SIG_IGN:
                self._before[one] = signal.signal(one, self.take)  # else: nohup
        try:
            yield
        finally:
            self._give_back()

    def _give_back(self) -> None:
        for one, handler in self._before.items():
            signal.signal(one, handler)
