"""Timing failures, critical sections and timed sections (Stewart 1994, 6.3 and 6.7.2).

The interface between a module and its executor for timing: the kinds of failure, the
answers of a handler, and the `Watch` of ``self.task`` that delays failures and times
sections. A task process has a native `Watch`; `PythonWatch` is that of the bench and
the simulator, where time is virtual.
"""

from __future__ import annotations

import math
import time
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

from msgspec import Struct

from pbonet.errors import MethodError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from contextlib import AbstractContextManager

MOST_SECTIONS = 16
"""How many timed sections a task may have."""
LONGEST_SECTION = 23
"""Bytes of a section's name, as UTF-8."""


class TimingFailure(StrEnum):
    """How a cycle can fail in time (section 6.3)."""

    DEADLINE = "deadline"
    """The deadline was reached with the cycle unfinished."""
    MAXEXEC = "maxexec"
    """The cycle has used the CPU time that it may use, and is unfinished."""
    MINEXEC = "minexec"
    """The least CPU time of a cycle can no longer be granted before the deadline."""

    @property
    def meaning(self) -> str:
        """A description in words."""
        return _MEANINGS[self]


_MEANINGS = {
    TimingFailure.DEADLINE: "the deadline was reached with the cycle unfinished",
    TimingFailure.MAXEXEC: "the cycle used up its CPU time and is unfinished",
    TimingFailure.MINEXEC: "the least CPU time of a cycle cannot be granted any more",
}


class Recovery(StrEnum):
    """Answer of a handler of timing failures; None means `CONTINUE`."""

    CONTINUE = "continue"
    """Continue the cycle where it was interrupted."""
    ABORT = "abort"
    """Abort the cycle: discard its outputs, and run `on` again before the next one,
    with in-vars and out-vars read again."""
    SKIP = "skip"
    """Continue the cycle, and skip the next release."""


class CycleAborted(BaseException):
    """Unwinds the cycle whose timing failure was answered with `Recovery.ABORT`.

    No `Exception`, so that a module that catches those is still aborted.
    """


class Section(Struct, frozen=True):
    """Measurements of one timed section (section 6.7.2); CPU nanoseconds."""

    count: int
    """How often it was run through."""
    total_ns: int
    min_ns: int
    max_ns: int


class Watch(Protocol):
    """Implementation of the timing part of ``self.task``."""

    @property
    def criticality(self) -> int:
        """Criticality of this cycle; set by a handler, it holds until the next one."""
        ...

    @criticality.setter
    def criticality(self, value: int, /) -> None: ...

    @property
    def deadline(self) -> float:
        """Deadline of this cycle, seconds after its release; set as `criticality`."""
        ...

    @deadline.setter
    def deadline(self, value: float, /) -> None: ...

    def critical(self) -> AbstractContextManager[object]:
        """Return the context that delays timing failures; nothing is allocated."""
        ...

    def timed(self, name: str) -> AbstractContextManager[object]:
        """Return what times the section `name`; one object for each name."""
        ...


class Watched(Protocol):
    """The task that a `PythonWatch` belongs to."""

    name: str
    handler: int | None
    handling: TimingFailure | None

    @property
    def crit(self) -> int:
        """Its own criticality."""
        ...

    @property
    def period(self) -> float:
        """Seconds; 0 for a task that is not periodic."""
        ...

    @property
    def now(self) -> int:
        """Release of this cycle, nanoseconds."""
        ...

    @property
    def cyclecount(self) -> int:
        """Cycles executed so far."""
        ...


def check_criticality(task: Watched, value: int) -> int:
    """Return `value` if a handler may set it as the criticality of its task.

    Args:
        task: The task whose handler sets it.
        value: From 1 to the larger of the task's own and its handler's criticality, so
            that no module rises above what its RMOD was verified with.

    Raises:
        MethodError: The value is not allowed, or no handler is running.
    """
    _check_handling(task, "criticality")
    most = max(task.crit, task.handler or 0)
    if not _is(value, int) or not 1 <= value <= most:
        raise MethodError(
            "a handler cannot set this criticality",
            where=task.name,
            expected=f"a whole number from 1 to {most}, the larger of the task's own "
            "and its handler's",
            got=repr(value),
            remedy="choose a lower one, or raise CRIT or HANDLER in the .rmod file",
        )
    return value


def check_deadline(task: Watched, value: float) -> float:
    """Return `value` if a handler may set it as the deadline of this cycle.

    Args:
        task: The task whose handler sets it.
        value: Seconds after the cycle's release, above 0.

    Raises:
        MethodError: The value is not allowed, or no handler is running.
    """
    _check_handling(task, "deadline")
    if not _is(value, int, float) or not 0.0 < value < math.inf:
        raise MethodError(
            "a handler cannot set this deadline",
            where=task.name,
            expected="seconds after the release of this cycle, above 0",
            got=repr(value),
        )
    return float(value)


def _check_handling(task: Watched, what: str) -> None:
    if task.handling is None:
        raise MethodError(
            f"self.task.{what} is set by a handler of timing failures only",
            where=task.name,
            remedy="set it in `timing_failure`; CRIT and FREQ in the .rmod file hold "
            "for every cycle",
        )


def check_section(name: str, known: Collection[str], *, where: str) -> None:
    """Refuse a new timed section that has no room or no proper name.

    Args:
        name: Of the new one.
        known: Names of the sections that the task has.
        where: The task.

    Raises:
        MethodError: It cannot be.
    """
    if not _is(name, str) or not 0 < len(_bytes(name)) <= LONGEST_SECTION:
        raise MethodError(
            "a timed section cannot have this name",
            where=where,
            expected=f"text of 1 to {LONGEST_SECTION} bytes",
            got=repr(name),
            remedy="shorten it",
        )
    if len(known) >= MOST_SECTIONS:
        raise MethodError(
            f"there is no room for the timed section {name}",
            where=where,
            expected=f"at most {MOST_SECTIONS} names in a task",
            got=f"one more than {', '.join(known)}",
            remedy="use a name again, and make none up while the task runs",
        )


def _is(value: object, *kinds: type) -> bool:
    """Return whether a module, typed or not, gave one of `kinds`."""
    return isinstance(value, kinds) and not isinstance(value, bool)


def _bytes(name: str) -> bytes:
    return name.encode("utf-8", errors="surrogatepass")


class _Critical:
    """A critical section; nests."""

    def __init__(self) -> None:
        self.depth = 0
        self.count = 0
        self.held: list[Callable[[], object]] = []

    def __enter__(self) -> None:
        self.depth += 1
        self.count += self.depth == 1

    def __exit__(self, *_: object) -> None:
        self.depth -= 1
        if self.held and not self.depth:
            held, self.held = self.held, []
            for call in held:  # the first that ends the cycle ends the others with it
                call()


class _Timed:
    """A timed section; what nests within itself counts once."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._depth = 0
        self._began = 0
        self.count = self.total = self.most = 0
        self.least = 0

    def __enter__(self) -> None:
        self._depth += 1
        if self._depth == 1:
            self._began = self._clock()

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if not self._depth:
            took = self._clock() - self._began
            self.least = min(self.least, took) if self.count else took
            self.most = max(self.most, took)
            self.total += took
            self.count += 1


class PythonWatch:
    """The `Watch` of a task in virtual time.

    Nothing fails in time by itself here; `pbonet.testing.Bench.timing_failure` has a
    test say when. Timed sections measure the real CPU time of this thread.

    Args:
        task: The task it belongs to.
        clock: CPU time of this thread in nanoseconds.
    """

    def __init__(
        self, task: Watched, clock: Callable[[], int] = time.thread_time_ns
    ) -> None:
        self._task = task
        self._clock = clock
        self._critical = _Critical()
        self._timed: dict[str, _Timed] = {}
        self._crit: tuple[tuple[int, int], int] | None = None
        self._deadline: tuple[tuple[int, int], float] | None = None

    @property
    def criticality(self) -> int:
        """That of the task, or what a handler set in this cycle."""
        if self._crit is not None and self._crit[0] == self._cycle():
            return self._crit[1]
        return self._task.crit

    @criticality.setter
    def criticality(self, value: int) -> None:
        self._crit = (self._cycle(), check_criticality(self._task, value))

    @property
    def deadline(self) -> float:
        """The period, or what a handler set in this cycle; seconds."""
        if self._deadline is not None and self._deadline[0] == self._cycle():
            return self._deadline[1]
        return self._task.period

    @deadline.setter
    def deadline(self, value: float) -> None:
        self._deadline = (self._cycle(), check_deadline(self._task, value))

    @property
    def in_critical(self) -> bool:
        """Whether timing failures are held off now."""
        return self._critical.depth > 0

    @property
    def criticals(self) -> int:
        """How many critical sections were entered, those within others left out."""
        return self._critical.count

    def critical(self) -> AbstractContextManager[None]:
        """Return a context that delays timing failures."""
        return self._critical

    def when_free(self, call: Callable[[], object]) -> None:
        """Call `call` at the end of the critical section, or now outside of one."""
        if self._critical.depth:
            self._critical.held.append(call)
        else:
            call()

    def timed(self, name: str) -> AbstractContextManager[None]:
        """Return what times the section `name`.

        Raises:
            MethodError: The name cannot be, or there is no room for one more.
        """
        try:
            return self._timed[name]
        except KeyError:
            check_section(name, self._timed, where=self._task.name)
            return self._timed.setdefault(name, _Timed(self._clock))

    def sections(self) -> dict[str, Section]:
        """Return the measurements of completed sections so far, by name."""
        return {
            name: Section(one.count, one.total, one.least, one.most)
            for name, one in self._timed.items()
            if one.count
        }

    def _cycle(self) -> tuple[int, int]:
        """Return a value that differs in every cycle."""
        return self._task.cyclecount, self._task.now
