"""Waiting for the end of a step: for signals, conditions or time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from pbonet.analysis import legality
from pbonet.config import Condition, StepEnd, parse
from pbonet.errors import ConditionError, ConfigError, NoAnswerError, StateError
from pbonet.master.configuration import Asked, must_hold
from pbonet.xm.net import messages as m

from . import task_signal_inbox
from .argument_text import check_time
from .condition_gate import LOOK_TIME

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pbonet.config import Variable
    from pbonet.master.configuration import Clock

    from .subsystem_tasks import SubsystemTasks
    from .task_signal_inbox import Inbox

FAILURES: Final = ("ERROR", "SHUTDOWN")
"""Signals that end a wait with an error."""
_PACE: Final = 0.1
"""Seconds between two checks when no condition is waited for; events come earlier."""
_SETTLE_TIME: Final = 0.5
"""Seconds that a task may be ON after its signal ERROR before it counts as ON."""
_SIGNAL: Final = re.compile(r"(?:(\S+) +)?([A-Za-z_]\S*)")


def parsed(text: str) -> StepEnd:
    """Return an end from its text: ``SIGNAL``, ``task SIGNAL`` or ``(condition)``.

    Raises:
        ConfigError: It is none of these.
    """
    text = text.strip()
    if text.startswith("(") and text.endswith(")"):
        return StepEnd(condition=parse(text[1:-1].strip()).text)
    match = _SIGNAL.fullmatch(text)
    if match is None:
        raise ConfigError(
            "this is neither a signal nor a condition",
            expected="SIGNAL, task SIGNAL or (condition)",
            got=text,
            remedy="write a condition in parentheses, such as (WIDTH < 0.04)",
        )
    return StepEnd(task=match[1] or "", signal=match[2])


class StepEnds:
    """Waits for ends of steps.

    Args:
        task_set: The subsystem's tasks.
        inbox: Their signals.
        clock: The clock of times.
    """

    def __init__(self, task_set: SubsystemTasks, inbox: Inbox, clock: Clock) -> None:
        self._task_set = task_set
        self._inbox = inbox
        self._clock = clock
        self._name = task_set.files.sbs.subsystem
        self._sent: dict[str, float] = {}
        """When each task that is still ON was seen to have sent an error."""

    def wait(
        self,
        ends: Sequence[StepEnd],
        *,
        seconds: float | None,
        timeout: float | None,
        look: Callable[[], None],
    ) -> StepEnd | None:
        """Wait for one of several ends, as `Subsystem.until` says.

        Args:
            ends: The ends.
            seconds: It ends after so many seconds in any case.
            timeout: Seconds after which it has failed.
            look: Called before each look; an error of it ends the wait.

        Returns:
            The end that came; None: the `seconds` are over.

        Raises:
            PbonetError: As `Subsystem.until` says.
        """
        check_time(seconds)
        check_time(timeout)
        self.must_be_answerable(ends)
        begin = self._clock.now()
        limit = min((t for t in (seconds, timeout) if t is not None), default=None)
        pace = LOOK_TIME if any(one.condition for one in ends) else _PACE
        with task_signal_inbox.wake_on_events(self._task_set.clients) as news:
            self._must_be_known(ends)
            while True:
                look()
                found = self._found(ends)
                if found is not None:
                    self._inbox.forget(but=FAILURES)
                    return found
                left = pace if limit is None else begin + limit - self._clock.now()
                if left <= 0:
                    break
                self._clock.wait(min(left, pace), news)
                news.clear()
        if limit == seconds:
            self._inbox.forget(but=FAILURES)
            return None
        raise self._too_late(ends, timeout or 0.0)

    def holds(self, end: StepEnd) -> bool:
        """Return whether a condition holds now.

        Raises:
            VerificationError: It cannot be evaluated.
        """
        self.must_be_answerable([end])
        return not self._refusal(end)

    def must_be_answerable(self, ends: Sequence[StepEnd]) -> None:
        """Refuse conditions that the table cannot answer.

        Raises:
            VerificationError: A variable is unknown, or sizes or units do not fit.
        """
        asked = [Condition(one.condition, one.place) for one in ends if one.condition]
        problems = legality.check_conditions(asked, self._variables)
        if problems:
            raise legality.as_error(problems)

    @property
    def _variables(self) -> Sequence[Variable]:
        return self._task_set.files.table.variables

    def _statuses(self) -> list[m.TaskStatus]:
        rtpus = self._task_set.refresh(strict=False)
        return [task for rtpu in rtpus for task in rtpu.tasks]

    def _refusal(self, end: StepEnd) -> str:
        """Return why a condition does not hold now; empty if it holds."""
        asked = Asked("UNTIL", self._name, Condition(end.condition, end.place))
        keeper = self._task_set.files.sbs.keeper

        def values(names: list[str]) -> list[m.VarValue]:
            request = m.Display(names=names)
            return self._task_set.clients.call(keeper, request, list[m.VarValue])

        try:
            must_hold([asked], self._variables, values)
        except ConditionError as error:
            return error.what.partition("(seen: ")[2].removesuffix(")") or error.what
        return ""

    def _found(self, ends: Sequence[StepEnd]) -> StepEnd | None:
        """Return the end that has come; None: none has.

        Raises:
            StateError: A task has failed, or there is none any more.
        """
        statuses = self._statuses()
        if not statuses:
            raise StateError(
                "there are no tasks any more",
                where=self._name,
                remedy="they were stopped; start the program again",
            )
        awaited = {one.signal for one in ends if not one.task}
        self._must_not_fail(statuses, [k for k in FAILURES if k not in awaited], ends)
        for one in ends:
            tasks = [one.task] if one.task else []
            if one.signal and self._inbox.take(statuses, [one.signal], tasks):
                return one
        for one in ends:
            if one.condition and not self._refusal(one):
                return one
        return None

    def _must_not_fail(
        self,
        statuses: Sequence[m.TaskStatus],
        signals: Sequence[str],
        ends: Sequence[StepEnd],
    ) -> None:
        """Refuse signals ERROR and SHUTDOWN that no fallback makes good.

        Raises:
            StateError: There is one.
        """
        awaited = {(one.task, one.signal) for one in ends}
        for sent in self._inbox.pending(statuses):
            if sent.signal not in signals or (sent.task, sent.signal) in awaited:
                continue
            if self._may_settle(sent.task, statuses):
                continue
            self._inbox.take(statuses, [sent.signal], [sent.task])
            good = [one for one in statuses if one.fallback_of == sent.task]
            if any(one.state == "ON" or one.stands_by for one in good):
                continue
            told = [one.error for one in statuses if one.task == sent.task]
            raise StateError(
                f"the task {sent.task} sent {sent.signal}",
                where=f"{sent.rtpu}/{sent.task}",
                got=next(filter(None, told), ""),
                remedy=f"'status {sent.task}' and the events say why",
            )

    def _may_settle(self, task: str, statuses: Sequence[m.TaskStatus]) -> bool:
        """Return whether a task that sent ERROR may be about to leave the state ON.

        The signal comes a moment before the state ERROR, and a change that turns such
        a task off as if it were ON would be refused.
        """
        on = any(one.task == task and one.state == "ON" for one in statuses)
        now = self._clock.now()
        return on and now - self._sent.setdefault(task, now) < _SETTLE_TIME

    def _must_be_known(self, ends: Sequence[StepEnd]) -> None:
        """Refuse signals and tasks that do not exist.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: No task has such a signal.
        """
        signals = [one for one in ends if one.signal]
        statuses = self._statuses() if signals else []
        for one in signals:
            task_signal_inbox.must_be_known(
                [one.signal],
                [one.task] if one.task else [],
                statuses,
                self._task_set.model,
                self._name,
            )

    def _too_late(self, ends: Sequence[StepEnd], timeout: float) -> NoAnswerError:
        seen = [self._refusal(one) for one in ends if one.condition]
        pending = self._inbox.pending(self._statuses())
        seen += [f"signal {one.task} {one.signal}" for one in pending]
        return NoAnswerError(
            f"no {' or '.join(map(str, ends))} within {timeout:g} s",
            where=self._name,
            got="; ".join(filter(None, seen)),
            remedy="give it more time, or see in 'status' why it does not come",
        )
