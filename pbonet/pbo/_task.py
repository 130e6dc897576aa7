"""A module's view of the task that runs it: ``self.task`` (Stewart 1994, 3.6)."""

from __future__ import annotations

from collections import deque
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING, Final, NoReturn, Protocol

from msgspec import Struct

from pbonet.errors import MethodError, StateError, did_you_mean
from pbonet.ports import here

from ._handling import (
    UNNUMBERED,
    Code,
    ErrorScope,
    Handler,
    Handling,
    Jump,
    Kept,
    checked,
    covers,
    line_of,
    number_of,
    place_of,
    said,
)
from ._schedule import Counted, IllegalHook, Schedule
from ._signals import Signal
from ._state import State
from ._timing import PythonWatch, TimingFailure, Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from contextlib import AbstractContextManager

    from numpy.random import Generator, SeedSequence


class Answer(StrEnum):
    """Answers of `on`, `error` and `clear` (Stewart 1994, section 3.6)."""

    OFF = "OFF"
    """`on`: not yet, stay OFF. `error`, `clear`: the task may be turned on again."""
    CONTINUE = "CONTINUE"
    """`error` only: the cause is gone and it is safe to continue."""
    ERROR = "ERROR"
    """`error`, `clear`: an operator is needed."""


_TO_OTHERS: Final = ("on", "off", "clear", "kill")
"""Signals that a module may send to another task."""


class TaskFailure(BaseException):
    """Unwinds the method that called `TaskContext.fail`.

    No `Exception`, so that a module which catches those does not catch its own failure.

    Args:
        error: What the module said.
        answer: What `error` answered, when it was asked already.
    """

    def __init__(self, error: MethodError, answer: Answer | None = None) -> None:
        super().__init__(str(error))
        self.error = error
        self.answer = answer


class Notice(Struct, frozen=True):
    """A signal or a warning of a task, on its way to the master."""

    bits: int
    """The signal; `Signal.WARNING` for a warning."""
    text: str
    code: int
    cycle: int
    now: int
    """Nanoseconds, as `TaskContext.now`."""
    handled: bool = False
    """It is an error that a handler of the module has put right."""
    place: str = ""
    """Where it happened, ``file:line in method``, if known."""
    order: tuple[str, str] | None = None
    """Another task, and the signal for it; None: it is for the master."""


class Outbox(Protocol):
    """Takes the notices of a task; must not wait, for it is called within a cycle."""

    def put(self, notice: Notice) -> None:
        """Take `notice`; what cannot be kept is dropped and counted."""


class BoundedOutbox:
    """Keeps the last notices until they are drained.

    Args:
        size: How many are kept; older ones are dropped.
    """

    def __init__(self, size: int = 256) -> None:
        self._notices: deque[Notice] = deque(maxlen=size)
        self.dropped = 0

    def put(self, notice: Notice) -> None:
        """Keep `notice`, dropping the oldest when there is no room."""
        if len(self._notices) == self._notices.maxlen:
            self.dropped += 1
        self._notices.append(notice)

    def drain(self) -> list[Notice]:
        """Return all kept notices, oldest first, and forget them."""
        notices: list[Notice] = []
        while self._notices:
            notices.append(self._notices.popleft())
        return notices


class TaskContext:
    """``self.task``: the task that runs a module, as the module sees it.

    Modules read the attributes and call `signal`, `warn` and `fail`; everything else is
    set by the runtime.

    Args:
        name: The task's name.
        rmod: The name of the RMOD it runs.
        freq: Cycles per second; 0 for a task that is not periodic.
        source: Where time, cycle count and criticality come from.
        outbox: Where signals and warnings go.
        handler: The criticality at which the handler of timing failures runs; None
            for the task's own.
        watch: Holds timing failures off and times sections; by default one for
            virtual time.
        seed: Where `rng` begins.
    """

    safe_at: Collection[str] = ()
    """The timing failures at which the out-vars have got their safe values before
    `timing_failure` is called, and the cycle's outputs are discarded (SAFE)."""
    _stamp = 0

    def __init__(
        self,
        name: str = "task",
        *,
        rmod: str = "",
        freq: float = 0.0,
        source: Schedule | None = None,
        outbox: Outbox | None = None,
        handler: int | None = None,
        watch: Watch | None = None,
        seed: int = 0,
    ) -> None:
        self.name = name
        self.rmod = rmod or name
        self.state = State.NOT_CREATED
        """The state while this method executes."""
        self.nextstate = State.OFF
        """The state after this method, if it succeeds."""
        self.errmsg = ""
        """The last error or warning."""
        self.errnum = 0
        """Its number: 0 for none, 1 for an exception, else as the module gave it."""
        self.freq = freq
        self.nwarnings = 0
        """Warnings since the task was turned on."""
        self.signals = 0
        """Every signal sent since the task was turned on, as bits."""
        self.arg = ""
        """The text that came with the signal that is being carried out."""
        self.handover = False
        """Whether the outputs go on without an interval.

        In `off`: a successor takes them over at once. In `on`: the task goes on from
        what a predecessor, or itself before an aborted cycle, has just written. False:
        their writer has been turned off, has failed or has died, however long ago.
        """
        self.off_requested = False
        """True when the module has sent `Signal.OFF`; the runtime obeys."""
        self.source: Schedule = source or Counted()
        self.outbox: Outbox = outbox or BoundedOutbox()
        self.on_fail: Callable[[MethodError], Answer] | None = None
        """How the runtime asks the module's `error`; None where it cannot."""
        self.handler = handler
        self.handling: TimingFailure | None = None
        """In `timing_failure`: the failure that is handled; else None."""
        self.watch: Watch = watch or PythonWatch(self)
        self.seed = seed
        """The seed of `rng`, which is recorded."""
        self._rng: Generator | None = None
        self._aborts = 0
        self.scopes: list[ErrorScope] = []
        """Scopes with handlers of errors, the innermost last."""
        self._kept: list[Kept] = []
        self.at: Callable[[], str] = str
        """Returns the running part of a combination; empty for a single module."""
        self.in_vars: frozenset[str] = frozenset()
        """Attributes of the module's in-vars."""
        self.is_stale: Callable[[str], bool] | None = None
        """The function that checks the age of an in-var; None if values do not age."""
        self.age_of: Callable[[str], float] | None = None
        """Returns the age of an in-var in seconds; None if values do not age."""
        self.stamp_of: Callable[[str], int] | None = None
        """Returns the time stamp that outputs made of this in-var alone would have."""
        self.libraries: tuple[str, ...] = ()
        """Folders of modules, in which a file that a parameter names is looked for."""
        self.on_illegal: IllegalHook | None = None
        """How the runtime raises or withdraws the task's entries in the flag."""

    @cached_property
    def shared(self) -> dict[str, object]:
        """Objects that the parts of a combination use together, such as a device."""
        return {}

    @property
    def sigmask(self) -> int:
        """Signals that the master does not want from this task, as bits."""
        return 0

    @property
    def now(self) -> int:
        """The release of this cycle in nanoseconds of CLOCK_MONOTONIC.

        Simulation and replay supply it, so a module takes the time from nowhere else.
        """
        return self.source.now

    @property
    def cyclecount(self) -> int:
        """Cycles executed since the task was turned on."""
        return self.source.cyclecount

    @property
    def crit(self) -> int:
        """The present criticality (section 6.2.3); 0 before the task is ranked."""
        return self.source.crit

    @property
    def stamp_ns(self) -> int:
        """Time at which the outputs were measured, as `now`; 0: that of the inputs.

        With 0 the outputs have the time stamp of the oldest input whose age is passed
        on, and without such an input that of the copy-out. Set by a module that passes
        on values of another age, such as those from another machine: ages and MAXAGE of
        its outputs then count from there. Holds until it is set again, or the task is
        turned on.
        """
        return self._stamp

    @stamp_ns.setter
    def stamp_ns(self, value: int) -> None:
        self._stamp = value

    @property
    def period(self) -> float:
        """Seconds from one release to the next; 0 for a task that is not periodic."""
        return 1.0 / self.freq if self.freq else 0.0

    @property
    def criticality(self) -> int:
        """The criticality of this cycle: `crit`, unless a handler changed it.

        Set in `timing_failure` only: at most the larger of the task's own and its
        handler's (HANDLER in the RMOD); holds until the next release (section 6.3).
        """
        return self.watch.criticality

    @criticality.setter
    def criticality(self, value: int) -> None:
        self.watch.criticality = value

    @property
    def deadline(self) -> float:
        """The deadline of this cycle, in seconds after its release.

        Set in `timing_failure` only; holds until the next release or event.
        """
        return self.watch.deadline

    @deadline.setter
    def deadline(self, value: float) -> None:
        self.watch.deadline = value

    @property
    def rng(self) -> Generator:
        """Random numbers that a replay repeats: a generator of numpy.

        Its seed is chosen when the task is created, and recorded. It continues through
        ``off``, ``on``, ``reinit`` and ``clear``; a task that is created again has
        another seed. After a cycle that a timing failure aborts it begins again with
        other numbers, because it is unknown how much that cycle had drawn. Virtual time
        always has the same seeds, and a bench has the one that it is given.

        The first use imports ``numpy.random``: make it in `init`, not in a cycle.
        """
        if self._rng is None:
            from numpy.random import default_rng

            self._rng = default_rng(self._sequence())
        return self._rng

    def restart_rng(self) -> None:
        """Continue with other random numbers after a cycle that did not end."""
        self._aborts += 1
        if self._rng is not None:
            fresh = type(self._rng.bit_generator)(self._sequence())
            self._rng.bit_generator.state = fresh.state

    def _sequence(self) -> SeedSequence:
        from numpy.random import SeedSequence

        return SeedSequence(self.seed, spawn_key=(self._aborts,))

    def critical(self) -> AbstractContextManager[object]:
        """Hold timing failures off: ``with self.task.critical(): ...`` (section 6.3).

        A failure within it is handled at its end. Sections nest; each is to be short,
        for the time that they may take is bounded, and what takes longer is
        interrupted and counted.
        """
        return self.watch.critical()

    def timed(self, name: str) -> AbstractContextManager[object]:
        """Time a section: ``with self.task.timed("jacobian"): ...`` (section 6.7.2).

        Count, total, least and greatest CPU time appear in the task's profile.

        Args:
            name: Of the section: at most 23 bytes, and at most 16 names in a task.

        Raises:
            MethodError: The name cannot be, or there is no room for one more.
        """
        return self.watch.timed(name)

    def stale(self, port: str) -> bool:
        """Return whether an in-var is older than its MAXAGE or ``max_age`` (5.5.2).

        A variable that was never written is stale, one without a limit never is.

        Args:
            port: The in-var, as the module spells it: ``self.task.stale("z1")``.

        Raises:
            MethodError: The module has no such in-var.
        """
        self._need_in_var(port)
        return self.is_stale is not None and self.is_stale(port)

    def age(self, port: str) -> float:
        """Return the age of an in-var in seconds; infinite: it was never written.

        It counts from the measurement where its writer passes that on, otherwise from
        when it was written, and includes the way from another machine.

        Args:
            port: The in-var, as the module spells it: ``self.task.age("z1")``.

        Raises:
            MethodError: The module has no such in-var.
        """
        self._need_in_var(port)
        return 0.0 if self.age_of is None else self.age_of(port)

    def pass_age_of(self, port: str) -> None:
        """Give the outputs the age of this in-var alone, until it is called again.

        For a module that chooses one of several inputs. It sets `stamp_ns`.

        Args:
            port: The in-var, as the module spells it.

        Raises:
            MethodError: The module has no such in-var.
        """
        self._need_in_var(port)
        if self.stamp_of is not None:
            self.stamp_ns = self.stamp_of(port)

    def _need_in_var(self, port: str) -> None:
        if port not in self.in_vars:
            raise MethodError(
                f"the module has no in-var {port}",
                where=self.name,
                expected=" or ".join(sorted(self.in_vars)) or "no in-vars at all",
                remedy=did_you_mean(port, self.in_vars),
            )

    def signal(self, signal: Signal | int, text: str = "") -> None:
        """Send `signal` to the master, unless it is masked; never waits.

        Args:
            signal: One of `Signal`, or a `UserSignal` of the module.
            text: Shown with it.
        """
        self.signals |= signal
        if signal & Signal.OFF:
            self.off_requested = True
        if signal & (Signal.ILLEGAL | Signal.LEGAL) and self.on_illegal is not None:
            self.on_illegal(text, up=bool(signal & Signal.ILLEGAL))
        self.announce(signal, text)

    def control(self, task: str, signal: str) -> None:
        """Send a signal to another task of this subsystem and machine; never waits.

        It goes to the task's RTPU, by neither master nor network, so it is there when
        none is: a handler of errors or of timing failures may turn off what depends on
        it (Stewart 1994, section 8.2.1). Nothing is verified; what the flag says
        follows.
        What became of it is an event of that task, a refusal one of this task.

        Args:
            task: The other task's name.
            signal: ``on``, ``off``, ``clear`` or ``kill``.

        Raises:
            StateError: There is no such signal, or the task is this one.
        """
        if signal not in _TO_OTHERS or task == self.name:
            raise StateError(
                f"task {self.name} cannot send {signal!r} to {task!r}",
                where=self.name,
                expected=f"one of {', '.join(_TO_OTHERS)}, for another task",
                remedy="correct it; for the task itself there is "
                "self.task.signal(Signal.OFF)",
            )
        text, order = f"{signal} to {task}", (task, signal)
        at = self.cyclecount, self.now
        self.outbox.put(Notice(0, text, 0, *at, order=order))

    def announce(self, signal: Signal | int, text: str = "") -> None:
        """Report a signal to the master without its effect on the task."""
        if wanted := self._wanted(int(signal)):
            self._notice(wanted, text, 0)

    def illegal(self, cause: str) -> None:
        """Raise the illegal-configuration flag (section 3.10); never waits.

        Critical tasks run `stable` from their next cycle on, until `legal` withdraws
        this entry and there is no other. It also ends when the task is no longer ON.

        Args:
            cause: The reason; at most 127 bytes of it are kept.
        """
        self.signal(Signal.ILLEGAL, cause)

    def legal(self, cause: str = "") -> None:
        """Withdraw what the module raised with `illegal`; harmless without.

        Args:
            cause: Which entry; by default all of this task's.
        """
        self.signal(Signal.LEGAL, cause)

    def warn(self, text: str, code: int = 0) -> None:
        """Report a problem that does not stop the task; never waits.

        Args:
            text: The problem, and what to do about it.
            code: A number that a program may look for.
        """
        self.nwarnings += 1
        self.errmsg = text
        self.errnum = code
        self.signals |= Signal.WARNING
        if self._wanted(int(Signal.WARNING)):
            self._notice(Signal.WARNING, text, code)

    def on_error(self, code: Code, handler: Handler | None = None) -> ErrorScope:
        """Handle errors within a block: ``with self.task.on_error(7, handler):`` (8.2).

        The innermost scope that covers an error comes first. An error that it corrects
        is reported as a warning with its place, and counted.

        Args:
            code: A number of ``fail()``, a class of exceptions, or None for all.
            handler: Called with the error; returns a `Handling`. None jumps.
        """
        return ErrorScope(self, code, handler)

    def always_on_error(self, code: Code, handler: Handler) -> None:
        """Handle errors for as long as the task lives, where no scope did.

        The latest that covers an error is asked, before the module's `error`, and
        wherever that would be asked: not in `init`, for instance. In a combination it
        counts for the part that calls this.

        Args:
            code: As for `on_error`.
            handler: As for `on_error`.
        """
        self._kept.append(Kept(code, handler, self.at()))

    def fail(self, text: str, code: int = UNNUMBERED, *, place: str = "") -> None:
        """Report an error; handlers and `error` decide whether this call returns.

        It returns if a handler or `error` returns CONTINUE; the method then continues
        after this call. With any other answer, and where neither is called (`error` is
        not in `init`, `kill`, `error`, `clear`, `set` and `get`), the method ends here.

        Args:
            text: The error, and what to do about it.
            code: A number that handlers and programs may look for, not 0.
            place: Where it happened; by default the line of this call.
        """
        error = MethodError(text, where=self.name)
        error.number, error.place = code, place or line_of(here(1))
        self.errmsg = text
        self.errnum = code
        for scope in reversed(self.scopes):
            answer = scope.ask(error) if scope.covers(error) else Handling.ABORT
            if answer is Handling.CONTINUE:
                return
            if answer is Handling.JUMP:
                raise Jump(scope)
        if self.on_fail is not None:
            kept = self.settle(error)
            if kept is Handling.CONTINUE:
                return
            if kept is Handling.JUMP:
                self._unwind(error, Answer.CONTINUE)
        self._fail(error)

    def settle(self, error: Exception) -> Handling:
        """Ask the handlers that live as long as the task; ABORT when none covers it."""
        at = self.at()
        for kept in reversed(self._kept):
            if kept.part in {"", at} and covers(kept.code, error):
                answer = self.handled(error, kept.handler)
                if answer is not Handling.ABORT:
                    return answer
        return Handling.ABORT

    def handled(self, error: Exception, handler: Handler) -> Handling:
        """Run a handler and report what it corrected; none is active meanwhile."""
        before = self.scopes, self._kept, self.on_fail
        self.scopes, self._kept, self.on_fail = [], [], None
        if isinstance(error, MethodError):
            self.errmsg = error.what
        else:
            self.errmsg = said(error)
        self.errnum = number_of(error)
        what = self.errmsg
        try:
            answer = checked(handler(error))
        except (Exception, TaskFailure) as second:
            new = second.error if isinstance(second, TaskFailure) else second
            note = f"this happened in the handler of: {what}"
            if note not in getattr(new, "__notes__", ()):  # one that is raised again
                new.add_note(note)
            raise
        finally:
            self.scopes, self._kept, self.on_fail = before
        if answer is not Handling.ABORT:
            self.outbox.put(
                Notice(
                    0,
                    f"{self.errmsg}: {answer}",
                    self.errnum,
                    self.cyclecount,
                    self.now,
                    handled=True,
                    place=place_of(error),
                )
            )
        return answer

    def _fail(self, error: MethodError) -> None:
        if self.on_fail is None:
            self._unwind(error, None)
        answer = self.on_fail(error)
        if answer is not Answer.CONTINUE:
            self._unwind(error, answer)

    def reset(self) -> None:
        """Reset the counters; called when the task is turned on."""
        self.signals = 0
        self.nwarnings = 0
        self.errmsg = ""
        self.errnum = 0
        self.off_requested = False
        self.stamp_ns = 0

    def _wanted(self, bits: int) -> int:
        """Count the signals that are not masked, and return them."""
        return bits & ~self.sigmask

    def _notice(self, bits: int, text: str, code: int) -> None:
        self.outbox.put(Notice(int(bits), text, code, self.cyclecount, self.now))

    @staticmethod
    def _unwind(error: MethodError, answer: Answer | None) -> NoReturn:
        raise TaskFailure(error, answer)
