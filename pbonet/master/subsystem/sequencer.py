"""Runs a program of jobs, which a ``.seq`` file has (Stewart 1994, section 4.4.3).

A `Sequencer` gives a `Subsystem` the commands that the lines stand for. It runs in one
thread; others may read its state, pause, resume and abort it.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec import Struct, structs

from pbonet.config import (
    EndRepeat,
    Finish,
    Goto,
    Order,
    Repeat,
    Step,
    line_text,
    loops,
)
from pbonet.errors import ConfigError, PbonetError, ReconfigError, StateError

from .condition_gate import LOOK_TIME, in_time

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from pbonet.config import SeqLine, StepEnd

    from .subsystem import Subsystem
    from .switching import Transition

_KEPT_STEPS: Final = 1000
_KEPT_ERRORS: Final = 100
_ATTEMPTS: Final = 2
"""How often a change after an error is tried before its own error counts."""
_PAUSE_LOOK: Final = 0.1
"""Seconds between two checks during a pause."""


class Phase(StrEnum):
    """The states of a sequence."""

    READY = "ready"
    ENTERS = "enters"
    """It changes to a job, or waits for its PRE and the former one's POST."""
    WAITS = "waits"
    """It waits for the end of a step."""
    PAUSED = "paused"
    DONE = "done"
    FAILED = "failed"
    ABORTED = "aborted"
    """By `Sequencer.abort`, or because the time is over."""
    STOPPED = "stopped"
    """Its tasks were stopped by another command."""


STOPPED_ELSEWHERE: Final = "stopped from elsewhere"
"""The reason of an end that another command, or another master, has caused."""
ENDED: Final = frozenset({Phase.DONE, Phase.FAILED, Phase.ABORTED, Phase.STOPPED})


class SequenceState(Struct, frozen=True, kw_only=True):
    """Where a sequence is."""

    name: str
    phase: Phase = Phase.READY
    line: int = -1
    """Index of the present line in `SeqFile.lines`; -1: none, or the safe job."""
    step: str = ""
    """The name of the present step."""
    job: str = ""
    """Its job."""
    waiting: str = ""
    """The ends that it waits for, as in the file; empty: none."""
    safe: bool = False
    """Whether it goes to its safe job, or is there."""
    pausing: bool = False
    """Whether it pauses, now or before the next line that changes something."""
    since: float = 0.0
    """When the phase began, in seconds of the subsystem's clock."""
    count: int = 0
    """How many steps were entered, the safe job included."""
    entered: tuple[str, ...] = ()
    """The last of them, the newest last, at most 1000."""
    failed: int = 0
    """How many errors there were."""
    errors: tuple[str, ...] = ()
    """The last of them, at most 100; each led to an ELSE, to the safe job or to the
    end."""
    text: str = ""
    """Why it has ended."""

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return self.phase in ENDED


class _CutError(Exception):
    """The sequence is to go to its safe job, or to end at once."""

    def __init__(self, phase: Phase, text: str) -> None:
        super().__init__(text)
        self.phase = phase


class Sequencer:
    """Runs the sequence with which a subsystem was opened.

    Args:
        subsystem: The subsystem; it is open.
        limit: Seconds after which the sequence is aborted; None: never.
        told: Called with each new state, in the thread that runs the sequence or that
            changes it.
        aborted: Set from outside to abort it, for example by a signal handler.

    Raises:
        ConfigError: The subsystem was not opened with a ``.seq`` file, or one of the
            jobs is missing, wrong, or of another subsystem.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        *,
        limit: float | None = None,
        told: Callable[[SequenceState], object] | None = None,
        aborted: threading.Event | None = None,
    ) -> None:
        if subsystem.files.seq is None:
            raise ConfigError(
                "the subsystem was opened without a sequence",
                where=str(subsystem.files.path),
                expected="a .seq file",
                remedy="open it as Subsystem('name.seq')",
            )
        self.seq = subsystem.files.seq
        self.jobs: dict[str, Path] = subsystem.files.step_jobs()
        """The file of each job."""
        self._subsystem = subsystem
        self._limit = limit
        self._told = told
        self._abort = aborted or threading.Event()
        self._reason = "aborted"
        self._guard = threading.RLock()
        self._go = threading.Event()
        self._go.set()
        self._single = False
        self._state = SequenceState(name=self.seq.name)
        self._around = loops(self.seq)
        self._turns: dict[int, int] = {}
        self._above: Step | None = None
        self._ended_by: StepEnd | None = None
        self._abandon = False
        self._begin = 0.0
        self._stops = 0
        self._unhandled = False
        self._given_up = False
        self._rests_in = ""
        """The present job, if its step has ended; empty: none, or it has not."""

    # -- from any thread ---------------------------------------------------------------

    @property
    def state(self) -> SequenceState:
        """Where it is now."""
        return self._state

    def pause(self) -> None:
        """Change nothing more: the present job goes on, but no line after it begins."""
        self._go.clear()
        self._show(pausing=True)

    def resume(self) -> None:
        """End a pause."""
        self._single = False
        self._go.set()
        self._show(pausing=False)

    def step(self) -> None:
        """During a pause, carry out the next line that changes something, then pause.

        Of a STEP line that is the change to its job and the wait for its end.
        """
        with self._guard:
            self._go.clear()
            self._single = True
        self._show(pausing=True)

    def abort(self, reason: str = "aborted") -> None:
        """Give the present step up and go to the safe job; given again, end at once.

        Without a safe job the present job stays as it is.

        Args:
            reason: Why, for the state.
        """
        self._reason = reason
        self._abort.set()

    def give_up(self) -> None:
        """End at once, without the safe job: the subsystem ends."""
        self._given_up = True
        self._abort.set()

    # -- in the thread of the sequence -------------------------------------------------

    def run(self) -> SequenceState:
        """Run the sequence to its end; its last job is ON afterwards.

        Returns:
            The last state; its `phase` says how the sequence has ended, and its `text`
            why.

        Raises:
            StateError: It has run already.
        """
        if self._state.phase is not Phase.READY:
            raise StateError(
                "the sequence has run already",
                where=self.seq.name,
                remedy="make another Sequencer for another run",
            )
        self._begin = self._subsystem.clock.now()
        self._stops = self._subsystem.stops
        if self._subsystem.simulation is None:
            files = self._subsystem.files
            self._subsystem.recordings.of(files.recorded_job(), files)
        try:
            phase, text = self._run()
        except _CutError as cut:
            phase, text = cut.phase, str(cut)
        except BaseException as error:
            self._show(phase=Phase.FAILED, text=str(error) or type(error).__name__)
            raise
        if phase is Phase.STOPPED and self._subsystem.stops != self._stops:
            with suppress(PbonetError):  # what a switch in progress has turned on again
                self._subsystem.stop()
        elif phase is Phase.ABORTED or (phase is Phase.FAILED and self._unhandled):
            self._go_safe()
        self._show(phase=phase, text=text, waiting="")
        return self._state

    def _run(self) -> tuple[Phase, str]:
        """Carry out the lines; return how and why they have ended."""
        at = 0
        while at < len(self.seq.lines):
            line = self.seq.lines[at]
            if isinstance(line, Finish):
                return (Phase.FAILED if line.failed else Phase.DONE), line.text
            try:
                self._must_go_on()
                after = self._line(at, line)
                if after <= at:  # a loop in which no step waits takes some time, too
                    self._subsystem.clock.wait(LOOK_TIME, self._abort)
                at = after
            except PbonetError as error:
                self._must_go_on()  # an abort or a stop is the cause
                self._must_have_tasks()
                self._note(error)
                if self._above is None or not self._above.otherwise:
                    self._unhandled = True
                    where = line.place.line if line.place else 0
                    return Phase.FAILED, f"line {where}, {_shown(line)}: {error}"
                self._abandon = True
                at = self.seq.at(self._above.otherwise)
        return Phase.DONE, ""

    def _line(self, at: int, line: SeqLine) -> int:
        """Carry out one line; return the index of the next one."""
        self._show(line=at)
        if isinstance(line, Step):
            self._hold()
            self._above, self._ended_by = line, None
            self._ended_by = self._do_step(line)
        elif isinstance(line, Order):
            self._hold()
            order(self._subsystem, line)
        elif isinstance(line, Goto):
            return self.seq.at(line.step) if self._goes(line) else at + 1
        elif isinstance(line, Repeat):
            self._turns[at] = 0
            self._above = _step_above(self.seq.lines, at)
        elif isinstance(line, EndRepeat):
            return self._next_turn(at)
        return at + 1

    def _next_turn(self, at: int) -> int:
        begin = self._around[at][-1]
        self._turns[begin] += 1
        times = getattr(self.seq.lines[begin], "times", 0)
        if times and self._turns[begin] >= times:
            return at + 1
        self._above = _step_above(self.seq.lines, begin)
        return begin + 1

    def _goes(self, line: Goto) -> bool:
        """Return whether a GOTO leads away."""
        if line.when is None:
            return True
        if line.when.condition:
            return self._subsystem.step_ends.holds(line.when)
        return self._ended_by is not None and str(self._ended_by) == str(line.when)

    def _do_step(self, step: Step) -> StepEnd | None:
        """Change to a step's job, and wait for its end; return which it was."""
        abandon, self._abandon = self._abandon, False
        self._show(phase=Phase.ENTERS, step=step.name, job=step.job, waiting="")
        file = self.jobs[step.job]
        kind = "SAFE" if self._state.safe else "STEP"
        note = f"{self.seq.name}: {kind} {line_text(step)[1]}"

        def halted() -> bool:
            self._must_have_tasks()
            return False

        rests = self._state.safe and self._rests_in == step.job
        self._rests_in = ""

        def attempt() -> Transition:
            self._must_have_tasks()  # each time: a stop may come during the wait
            change = partial(
                self._subsystem.change_to,
                file,
                abandon=abandon,
                note=note,
                halted=halted,
            )
            for _ in range(_ATTEMPTS if abandon else 0):
                with suppress(ReconfigError):  # another task failed meanwhile
                    return change()
            return change()

        done = in_time(attempt, self.seq.wait, self._subsystem.clock, self._abort)
        rests = rests and not (done.spawns or done.items or done.kills)
        entered = (*self._state.entered, step.name)[-_KEPT_STEPS:]
        self._show(entered=entered, count=self._state.count + 1)
        if rests or not step.waits:  # what it did is done, and not announced again
            self._rests_in = step.job
            return None
        self._show(phase=Phase.WAITS, waiting=_awaited(step))
        within = step.within
        if within is None and step.until and step.seconds is None:
            within = self.seq.within
        end = self._subsystem.step_ends.wait(
            step.until, seconds=step.seconds, timeout=within, look=self._must_go_on
        )
        self._rests_in = step.job
        return end

    def _go_safe(self) -> None:
        """Go to the safe job; note what fails."""
        step = self.seq.safe
        if step is None or self._given_up:
            return
        self._abort.clear()
        self._limit = None
        self._go.set()
        self._abandon = True
        self._show(safe=True, pausing=False, line=-1)
        try:
            self._do_step(step)
        except PbonetError as error:
            self._note(error)
        except _CutError as cut:
            self._note(f"the safe job {step.job} was given up: {cut}")

    def _hold(self) -> None:
        """Wait while it is paused."""
        if self._go.is_set():
            return
        before = self._state.phase
        self._show(phase=Phase.PAUSED, waiting="")
        while not self._go.is_set():
            with self._guard:
                if self._single:
                    self._single = False
                    break
            self._must_go_on()
            self._go.wait(_PAUSE_LOOK)
        self._show(phase=before)

    def _must_go_on(self) -> None:
        """Go on, unless the sequence is to end.

        Raises:
            _CutError: It is.
        """
        if self._subsystem.stops != self._stops:
            raise _CutError(Phase.STOPPED, STOPPED_ELSEWHERE)
        if self._abort.is_set():
            raise _CutError(Phase.ABORTED, self._reason)
        passed = self._subsystem.clock.now() - self._begin
        if self._limit is not None and passed >= self._limit:
            raise _CutError(Phase.ABORTED, f"{self._limit:g} s are over")

    def _must_have_tasks(self) -> None:
        """Refuse to go on after a stop from elsewhere, which would start it all again.

        Raises:
            _CutError: There are no tasks any more.
        """
        if self._state.count and not self._subsystem.status_all():
            raise _CutError(Phase.STOPPED, STOPPED_ELSEWHERE)

    def _note(self, error: object) -> None:
        errors = (*self._state.errors, str(error))[-_KEPT_ERRORS:]
        self._show(errors=errors, failed=self._state.failed + 1)

    def _show(self, **changes: object) -> None:
        with self._guard:
            if "phase" in changes and changes["phase"] != self._state.phase:
                changes["since"] = self._subsystem.clock.now()
            self._state = structs.replace(self._state, **changes)
            if self._told is not None:
                self._told(self._state)


def order(subsystem: Subsystem, line: Order) -> None:
    """Give the command of a SPAWN, KILL, SET or WRITE line.

    Raises:
        PbonetError: It was refused, or failed.
    """
    first, *rest = line.words
    if line.command == "spawn":
        subsystem.spawn(first, rest[0] if rest else None, keep=True)
    elif line.command == "kill":
        subsystem.kill(line.words)
    elif line.command == "set":
        subsystem.set(first, rest[0], rest[1:])
    else:
        subsystem.write(first, list(map(float, rest)))


def _awaited(step: Step) -> str:
    ends = [str(one) for one in step.until]
    ends += [f"{step.seconds:g} s"] if step.seconds is not None else []
    return " OR ".join(ends)


def _shown(line: SeqLine) -> str:
    return " ".join(filter(None, line_text(line)))


def _step_above(lines: Sequence[SeqLine], at: int) -> Step | None:
    """Return the step above a line in the file, whose ELSE is in force there."""
    above = [line for line in lines[:at] if isinstance(line, Step)]
    return above[-1] if above else None
