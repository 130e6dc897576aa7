"""Errors for a change that was carried out in part, or a task that exists already."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import (
    PbonetError,
    ReconfigError,
    SeveralError,
    StateError,
    TaskError,
)
from pbonet.pbo import State

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pbonet.xm.net import messages as m

    from .task_model import Member

_ANEW = {
    State.OFF: "'on {0}' turns it on, 'kill {0}' removes it",
    State.ON: "'off {0}', then 'kill {0}', to spawn it again",
    State.ERROR: "'clear {0}' brings it out of ERROR, 'kill {0}' removes it",
}
"""The remedy for a task that exists already."""


def all_stopped(results: Iterable[m.Stopped]) -> m.Stopped:
    """Return the results of several RTPUs as one."""
    from pbonet.xm.net import Stopped

    whole = Stopped(off=[], killed=[])
    for one in results:
        whole.off += one.off
        whole.killed += one.killed
        whole.failed |= one.failed
    return whole


def failed_at_end(stopped: m.Stopped) -> list[PbonetError]:
    """Return an error for each task that failed as it was turned off or killed."""
    return [
        TaskError(
            f"the task {name} failed as it ended: {text}",
            remedy="it has ended; see that what it controls is safe, and correct its "
            "off() or kill()",
        )
        for name, text in stopped.failed.items()
    ]


def must_be_stopped(
    stopped: m.Stopped, errors: list[PbonetError], unsure: Mapping[str, Sequence[str]]
) -> None:
    """Raise the errors of a stop; they name the tasks that were stopped nevertheless.

    Args:
        stopped: The tasks that were stopped.
        errors: Of the RTPUs that did not confirm.
        unsure: Tasks that may still be ON, by RTPU.

    Raises:
        SeveralError: An RTPU did not confirm, or a task failed as it ended; the parts
            say which, and why.
    """
    failed = failed_at_end(stopped)
    if not errors and not failed:
        return
    if not errors:
        count = "a task" if len(failed) == 1 else f"{len(failed)} tasks"
        raise SeveralError(
            f"all tasks have ended, but {count} failed as they did: "
            + " ".join(stopped.failed),
            failed,
            remedy="see that what they control is safe, and correct them",
        )
    count = "an RTPU" if len(errors) == 1 else f"{len(errors)} RTPUs"
    done = (
        " ".join([*stopped.off, *stopped.killed]) or "nothing, because nothing was ON"
    )
    on = "; ".join(
        f"{rtpu}: {' '.join(tasks)}" for rtpu, tasks in unsure.items() if tasks
    )
    raise SeveralError(
        f"{count} did not confirm the stop; on the others was turned off: {done}"
        + f"; may still be ON: {on}" * bool(on),
        [*errors, *failed],
        remedy="stop them by hand if they can do harm; an RTPU that was seen before is "
        "stopped by the other agents as soon as they see it again",
    )


def forced(task: Member) -> PbonetError:
    """Return the error for a task that did not turn OFF, and was ended by force."""
    return StateError(
        f"the task {task.name} hung and was terminated by force",
        where=f"{task.rtpu}/{task.name}",
        expected="'off' between two of its cycles",
        got=f"a method of module {task.rmod.module} that does not return",
        remedy="see what its cycle() or its off() waits for",
    )


def stuck(
    items: Sequence[tuple[str, str]],
    done: int,
    error: PbonetError,
    *,
    unsure: int = 0,
    remarks: Mapping[tuple[str, str], str] | None = None,
) -> ReconfigError:
    """Return the error with the failed item, those that were done, and the rest.

    Args:
        items: All items.
        done: How many were carried out.
        error: The error of the next one.
        unsure: How many further items were sent without an answer.
        remarks: Remarks on items that were not sent.
    """
    task, signal = items[done]
    rest = done + max(unsure, 1)
    known = {item: f" ({remark})" for item, remark in (remarks or {}).items()}
    parts = [
        f"{what}: "
        + ", ".join(f"{item[1]} {item[0]}{known.get(item, '')}" for item in some)
        for what, some in (
            ("done", items[:done]),
            ("sent, and not known whether done", items[done : done + unsure]),
            ("not sent", items[rest:]),
        )
        if some
    ]
    stuck = ReconfigError(
        f"item {done + 1} of {len(items)}, {signal} {task}: {error.what}",
        where=error.where,
        expected=error.expected,
        got=error.got,
        remedy="; ".join(filter(None, (error.remedy, *parts))),
        debug=error.debug,
    )
    stuck.done = done
    stuck.rest = tuple(items[done:])
    return stuck


def already(task: Member) -> StateError:
    """Return the error for a task that is to be spawned, and is there."""
    return StateError(
        f"there is a task {task.name} already",
        where=f"{task.rtpu}/{task.name}",
        got=f"state {task.state}",
        remedy=next_steps(task.state, task.name),
    )


def next_steps(state: str, task: str) -> str:
    """Return what may be done with a task in a state; empty for one that is not there.

    Args:
        state: Its state.
        task: Its name.
    """
    return _ANEW[State(state)].format(task) if state in _ANEW else ""
