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

    from .subsystem import Subsystem
    from .task_signal_inbox import Sent

FAILURES: Final = ("ERROR", "SHUTDOWN")
"""Signals that end a wait with an error."""
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


def wait(
    subsystem: Subsystem,
    ends: Sequence[StepEnd],
    *,
    seconds: float | None,
    timeout: float | None,
    look: Callable[[], None],
) -> StepEnd | None:
    """Wait for one of several ends, as `Subsystem.until` says.

    Args:
        subsystem: The subsystem.
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
    must_be_answerable(subsystem, ends)
    clock = subsystem.clock
    begin = clock.now()
    limit = min((t for t in (seconds, timeout) if t is not None), default=None)
    pace = LOOK_TIME if any(one.condition for one in ends) else _PACE
    with subsystem.news() as news:
        _must_be_known(subsystem, ends)
        while True:
            look()
            found = _found(subsystem, ends)
            if found is not None:
                subsystem.inbox.forget(but=FAILURES)
                return found
            left = pace if limit is None else begin + limit - clock.now()
            if left <= 0:
                break
            clock.wait(min(left, pace), news)
            news.clear()
    if limit == seconds:
        subsystem.inbox.forget(but=FAILURES)
        return None
    raise _too_late(subsystem, ends, timeout or 0.0)


_PACE: Final = 0.1
"""Seconds between two looks when no condition is waited for; events come earlier."""


def must_be_answerable(subsystem: Subsystem, ends: Sequence[StepEnd]) -> None:
    """Refuse conditions that the table cannot answer.

    Raises:
        VerificationError: A variable is unknown, or sizes or units do not fit.
    """
    conditions = [Condition(one.condition, one.place) for one in ends if one.condition]
    problems = legality.check_conditions(conditions, subsystem.files.table.variables)
    if problems:
        raise legality.as_error(problems)


def refusal(subsystem: Subsystem, end: StepEnd) -> str:
    """Return why a condition does not hold now; empty if it holds."""
    asked = Asked("UNTIL", subsystem.name, Condition(end.condition, end.place))
    keeper = subsystem.sbs.keeper

    def values(names: list[str]) -> list[m.VarValue]:
        request = m.Display(names=names)
        return subsystem.clients.call(keeper, request, list[m.VarValue])

    try:
        must_hold([asked], subsystem.files.table.variables, values)
    except ConditionError as error:
        return error.what.partition("(seen: ")[2].removesuffix(")") or error.what
    return ""


def failure(subsystem: Subsystem, statuses: Sequence[m.TaskStatus]) -> Sent | None:
    """Take a signal ERROR or SHUTDOWN that no fallback makes good; None: none."""
    return _failure(subsystem, statuses, FAILURES)


def _failure(
    subsystem: Subsystem, statuses: Sequence[m.TaskStatus], signals: Sequence[str]
) -> Sent | None:
    while signals and (sent := subsystem.inbox.take(statuses, signals, ())):
        task = sent.task
        good = [one for one in statuses if one.fallback_of == task]
        if not any(one.state == "ON" or one.stands_by for one in good):
            return sent
    return None


def _found(subsystem: Subsystem, ends: Sequence[StepEnd]) -> StepEnd | None:
    """Return the end that has come; None: none has.

    Raises:
        StateError: A task has failed, or there is none any more.
    """
    statuses = subsystem.status_all()
    if not statuses:
        raise StateError(
            "there are no tasks any more",
            where=subsystem.name,
            remedy="they were stopped; start the program again",
        )
    for one in ends:
        tasks = [one.task] if one.task else []
        if one.signal and subsystem.inbox.take(statuses, [one.signal], tasks):
            return one
    awaited = {one.signal for one in ends if not one.task}
    signals = [name for name in FAILURES if name not in awaited]
    if sent := _failure(subsystem, statuses, signals):
        raise failed(sent, statuses)
    for one in ends:
        if one.condition and not refusal(subsystem, one):
            return one
    return None


def failed(sent: Sent, statuses: Sequence[m.TaskStatus]) -> StateError:
    """Return the error for a task that has sent ERROR or SHUTDOWN."""
    texts = [one.error for one in statuses if one.task == sent.task and one.error]
    return StateError(
        f"the task {sent.task} sent {sent.signal}",
        where=f"{sent.rtpu}/{sent.task}",
        got=texts[0] if texts else "",
        remedy=f"'status {sent.task}' and the events say why",
    )


def _must_be_known(subsystem: Subsystem, ends: Sequence[StepEnd]) -> None:
    """Refuse signals and tasks that do not exist.

    Raises:
        UnknownTaskError: There is no such task.
        StateError: No task has such a signal.
    """
    signals = [one for one in ends if one.signal]
    statuses = subsystem.status_all() if signals else []
    for one in signals:
        task_signal_inbox.must_be_known(
            [one.signal],
            [one.task] if one.task else [],
            statuses,
            subsystem.model,
            subsystem.name,
        )


def _too_late(
    subsystem: Subsystem, ends: Sequence[StepEnd], timeout: float
) -> NoAnswerError:
    seen = [refusal(subsystem, one) for one in ends if one.condition]
    pending = [f"{one.task} {one.signal}" for one in subsystem.signals()]
    return NoAnswerError(
        f"no {' or '.join(map(str, ends))} within {timeout:g} s",
        where=subsystem.name,
        got="; ".join([*filter(None, seen), *(f"signal {one}" for one in pending)]),
        remedy="give it more time, or look at 'status' why it does not come",
    )
