"""Words of commands: signals, values, warnings."""

from __future__ import annotations

import fnmatch
import math
import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeGuard

from pbonet.errors import (
    ParameterError,
    StateError,
    UnknownVariableError,
    did_you_mean,
)
from pbonet.lazy import logger

from .subsystem_tasks import SIGNALS


def log_warning(text: str) -> None:
    """Take a warning and log it."""
    logger("pbonet.master").warning("%s", text)


_collector: ContextVar[Callable[[str], None] | None] = ContextVar(
    "collector", default=None
)


@contextmanager
def collected() -> Generator[list[str]]:
    """Collect the warnings that the commands of this thread give meanwhile.

    Commands of several threads may overlap: a stop waits for none of the others.
    """
    warnings: list[str] = []
    token = _collector.set(warnings.append)
    try:
        yield warnings
    finally:
        _collector.reset(token)


def collector() -> Callable[[str], None] | None:
    """Return the collector of warnings of this thread's command, if any."""
    return _collector.get()


def check_signal(signal: str) -> None:
    """Refuse a word that is no signal.

    Raises:
        StateError: It is none.
    """
    if signal not in SIGNALS:
        raise StateError(
            f"there is no signal {signal}",
            expected="one of " + " ".join(SIGNALS),
            remedy=did_you_mean(signal, SIGNALS),
        )


def check_rate(task: str, hz: float) -> None:
    """Refuse a number that is no frequency; how fast a task can run its RTPU knows.

    Raises:
        ParameterError: It is not above 0, or not finite.
    """
    if not (hz > 0 and math.isfinite(hz)):
        raise ParameterError(
            "no task can run at this frequency",
            where=task,
            expected="a number of Hz above 0",
            got=f"{hz:g} Hz",
            remedy=f"'off {task}' is how a task is halted",
        )


def check_time(seconds: float | None) -> None:
    """Refuse an invalid waiting time; None means no limit.

    Raises:
        StateError: It is negative, too long, or not a number.
    """
    if seconds is not None and not 0 <= seconds <= threading.TIMEOUT_MAX:
        raise StateError(
            "this is not a valid time limit",
            expected=f"0 to {threading.TIMEOUT_MAX:g} s",
            got=f"{seconds:g} s",
            remedy="give one within these; none at all waits for ever",
        )


def names_of(given: str | Iterable[str]) -> list[str]:
    """Return names, each once, whether one is given or several."""
    names = [given] if isinstance(given, str) else given
    return [name for name in dict.fromkeys(names) if name]


def is_sequence(value: object) -> TypeGuard[Sequence[object]]:
    """Return whether a value is a list or a tuple."""
    return isinstance(value, (list, tuple))


def sequence(value: object) -> Sequence[object]:
    """Return a list or tuple unchanged, anything else as a list of one item."""
    return value if is_sequence(value) else [value]


def local_words(value: object) -> str:
    """Return a parameter's value as the words of a LOCAL line."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if is_sequence(value):
        return " ".join(map(local_words, value))
    return str(value)


def task_of(writer: str | None) -> str | None:
    """Return the task's name of a writer, which may be on another machine."""
    if writer is None:
        return None
    from pbonet.svar.mirror import MARK

    return writer.partition(MARK)[0]


def matching(patterns: list[str], known: list[str]) -> list[str]:
    """Return the names that patterns match, in their order, each once.

    Raises:
        UnknownVariableError: One matches none.
    """
    found: list[str] = []
    for pattern in patterns:
        names = [name for name in known if fnmatch.fnmatchcase(name, pattern)]
        if not names:
            raise UnknownVariableError(
                f"the table has no variable {pattern}",
                remedy=did_you_mean(pattern, known) or "'display' shows them all",
            )
        found += [name for name in names if name not in found]
    return found
