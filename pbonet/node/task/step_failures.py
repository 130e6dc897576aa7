"""Failures of a step of a task's life, and how they are reported."""

from __future__ import annotations

import re
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from pbonet.errors import MethodError, PbonetError, SvarError
from pbonet.pbo import (
    Answer,
    Recovery,
    TaskFailure,
    innermost,
    memory,
    number_of,
    place_of,
    said,
    text_of,
)
from pbonet.ports import Kind
from pbonet.svar import table_files

if TYPE_CHECKING:
    from pbonet.node.wire import Outcome, Rule, Step
    from pbonet.pbo import PortBasedObject
    from pbonet.svar import Blamed

RAISED = (Exception, SystemExit, TaskFailure)
"""Exceptions caught around a module's methods: all but those that end Python."""

Raised = Exception | TaskFailure


REFUSED = {
    8: "no consistent set of inputs could be copied",
    16: "an output is not a finite number",
    32: "an output is outside its limits",
    64: "the outputs belong to another task",
    128: table_files.OVERWRITTEN,
}
"""Flags of a copy (`pbonet.svar.Flags`) that are errors of the task, with texts."""
ALL_REFUSED = sum(REFUSED)
OVERWRITTEN = 128
OUTSIDE = 32
ABOUT_ELEMENT = frozenset({16, OUTSIDE})


class StepFailed(Exception):  # noqa: N818 - carries a failure to the executor
    """A step failed."""

    def __init__(self, step: Step, cause: Raised) -> None:
        super().__init__(step, cause)
        self.step = step
        self.cause = cause


class RefusedError(Exception):
    """A step was requested that is not possible; the module is not at fault.

    Args:
        error: The error for the sender of the signal.
    """

    def __init__(self, error: PbonetError) -> None:
        super().__init__(str(error))
        self.error = error


def contained(error: BaseException) -> Raised:
    """Return a module's exception as one that can be handled.

    A module may raise anything; ``sys.exit()`` must not end the task's process, because
    the task would then miss its `off` and `kill`.
    """
    if isinstance(error, Exception | TaskFailure):
        return error
    wrapped = MethodError(
        said(error),
        remedy="raise an exception of the module's own; do not end the process",
    )
    wrapped.__traceback__ = error.__traceback__
    return wrapped


def refused(flags: int, blamed: Blamed) -> SvarError:
    """Return the error for the flags of a copy.

    Args:
        flags: At least one of them is in `REFUSED`.
        blamed: The variable and element to which they refer.
    """
    if flags & OVERWRITTEN:
        return table_files.overwritten()
    bit, text = next(item for item in REFUSED.items() if flags & item[0])
    keeps = "the table keeps its last values"
    if bit not in ABOUT_ELEMENT or not blamed.variable:
        return SvarError(text, remedy=keeps)
    advice = "find the cause in the module"
    if bit == OUTSIDE:
        advice = "bound it in the module, or set LIMIT clip in the .svar file"
    return SvarError(
        f"{text}: {blamed.variable}[{blamed.element}]",
        expected=blamed.expected if bit == OUTSIDE else "",
        got=blamed.got,
        remedy=f"{keeps}: {advice}",
    )


def too_old(blamed: Blamed) -> SvarError:
    """Return the error of a task that is to end in ERROR when an input is too old.

    Args:
        blamed: The input, with its age and its limit.
    """
    return SvarError(
        f"the input {blamed.variable} is too old",
        expected=blamed.expected,
        got=blamed.got,
        remedy="find why its writer, a link or a machine has stopped; clear the task "
        "when it writes again",
    )


def is_answer(answer: object) -> TypeGuard[Answer]:
    """Return whether a module, typed or not, returned an `Answer`."""
    return isinstance(answer, Answer)


def answered(found: Rule, step: Step, answer: object) -> Outcome | None:
    """Return the outcome by which the result of a step ends its rule; None: continue.

    Raises:
        MethodError: A method returned an answer that the rule does not allow.
    """
    if (answer is None or is_answer(answer)) and answer in found.answers:
        return found.answers[answer]
    raise bad_answer(step, answer, found)


def recovery(answer: object) -> Recovery:
    """Return the answer of a handler of timing failures.

    Raises:
        MethodError: It returned an unknown answer.
    """
    if answer is None:
        return Recovery.CONTINUE
    if isinstance(answer, Recovery):
        return answer
    raise MethodError(
        "timing_failure returned an invalid answer",
        expected=f"None or {' or '.join(f'Recovery.{one.name}' for one in Recovery)}",
        got=repr(answer),
        remedy="correct what it returns; no return at all means CONTINUE",
    )


def bad_answer(step: object, answer: object, found: Rule | None) -> MethodError:
    """Return the error for an invalid answer of `step`; `error` has no rule."""
    allowed = list(found.answers) if found else list(Answer)
    words = ["None" if one is None else f"Answer.{one}" for one in allowed]
    got = f"Answer.{answer}" if isinstance(answer, Answer) else repr(answer)
    return MethodError(
        f"{step} returned an invalid answer",
        expected=" or ".join(words),
        got=got,
        remedy="correct what it returns",
    )


def method_error(error: Raised, method: str, task: str) -> MethodError:
    """Return a method's exception as the error of the task, with number and place."""
    told = _method_error(error, f"{task}.{method}")
    cause = error.error if isinstance(error, TaskFailure) else error
    told.number = number_of(cause)
    told.place = place_of(cause)
    for note in getattr(cause, "__notes__", ()):
        add_remedy(told, str(note))
    return told


def _method_error(error: Raised, where: str) -> MethodError:
    if isinstance(error, TaskFailure):
        return MethodError(error.error.what, where=where, debug=_trace(error))
    if isinstance(error, RefusedError):
        error = error.error
    if isinstance(error, PbonetError):
        return MethodError(
            error.what if isinstance(error, MethodError) else f"{error}",
            where=where,
            expected=error.expected if isinstance(error, MethodError) else "",
            got=error.got if isinstance(error, MethodError) else "",
            remedy=error.remedy if isinstance(error, MethodError) else "",
            debug=error.debug or _trace(error),
        )
    remedy = ""
    if isinstance(error, ValueError) and "read-only" in text_of(error):
        remedy = (
            "inputs are written by their producers; take a copy: `x = self.x.copy()`"
        )
    return MethodError(
        said(error),
        where=where,
        remedy=remedy,
        debug=_trace(error),
    )


def name_bad_inputs(error: PbonetError, instance: PortBasedObject[Any]) -> None:
    """Add to the error of a cycle which inputs are no numbers, unless it names them."""
    arrays = memory(instance).arrays
    bad: list[str] = []
    for port in type(instance).__interface__.ports:
        array = arrays[port.attr]
        if port.kind is not Kind.INVAR or array.dtype.kind != "f":
            continue
        where = np.flatnonzero(~np.isfinite(array))
        if where.size and not _named(port.name, error.what):
            bad.append(f"{port.name}[{where[0]}]")
    if bad:
        verb = "is no finite number" if len(bad) == 1 else "are no finite numbers"
        add_remedy(error, f"of its inputs, {' and '.join(bad)} {verb}")


def _named(variable: str, text: str) -> bool:
    """Return whether a text names a variable, and not only a longer name."""
    return re.search(rf"(?<![\w^]){re.escape(variable)}(?![\w^])", text) is not None


def placed(text: str, place: str) -> str:
    """Return a message followed by the line of code, if that is known."""
    return f"{text} ({place})" if place else text


def own_place(trace: str) -> str:
    """Return the innermost line in the module's own folder from a crash's traceback.

    Args:
        trace: Lines of `faulthandler`, innermost first; lines of libraries called
            through ctypes are not the module's.
    """
    calls: list[tuple[str, str]] = []
    for call in _CALL.finditer(trace):
        if Path(__file__).parents[1] in Path(call[1]).parents:
            break  # the outer frames belong to the task's process
        calls.append((call[1], "{}:{} in {}".format(*call.groups())))
    return innermost(reversed(calls))


_CALL = re.compile(r'File "([^"]+)", line (\d+) in (.+)')


def add_remedy(error: PbonetError, text: str) -> None:
    """Add `text` at the end of an error's message."""
    error.remedy = f"{error.remedy}; {text}" if error.remedy else text


def _trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(error)).rstrip()
