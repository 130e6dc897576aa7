"""Constants that change while tasks exist (Stewart 1994, section 3.5).

A task takes its in-consts in when it is created. When another task gives them later, or
when their value changes, every task that took the old one is re-initialized, in the
order that constants demand, so that all tasks deal with the same constants.
"""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Final

from pbonet.analysis import legality
from pbonet.errors import NoAnswerError, PbonetError
from pbonet.xm.net import messages as m, rpc

if TYPE_CHECKING:
    from collections.abc import Collection, Generator, Iterable, Mapping, Sequence

    from pbonet.master.configuration import Member

    from .subsystem_tasks import SubsystemTasks


ARRIVAL_TIME: Final = 5.0
"""Seconds that a constant may take from one machine's table to another's."""
LOOK_TIME: Final = 0.005


def at_hand(task_set: SubsystemTasks, member: Member) -> None:
    """Wait until the machine of a task to be has the constants that others give.

    Raises:
        NoAnswerError: They did not come.
    """
    wanted = {*member.task.needs}
    given_at = {
        name: other.rtpu
        for other in task_set.model
        for name in wanted.intersection(other.task.gives)
    }
    _arrived(task_set, member, given_at)


def given(task_set: SubsystemTasks, task: str, leaving: Collection[str] = ()) -> None:
    """Re-initialize who uses the constants of a task that gives them from now on.

    Args:
        task_set: The subsystem's tasks.
        task: The one that was created, or took them over.
        leaving: Tasks that are about to be killed, and need not know.

    Raises:
        SeveralError: As `renew`; the task still gives them.
    """
    giver = task_set.model.find(task)
    gives = dict.fromkeys(giver.task.gives, giver.rtpu)
    renew(task_set, f"{task} gives {' and '.join(gives)}", gives, leaving)


def taken_over(
    coming: Iterable[Member], going: Iterable[Member]
) -> dict[str, list[str]]:
    """Return the tasks whose constants the tasks that replace them produce.

    The new values hold as soon as the new task is there, whatever the old ones were.
    """
    olds = list(going)
    found = {
        new.name: [
            old.name
            for old in olds
            if old.name != new.name and {*old.task.gives} & {*new.task.gives}
        ]
        for new in coming
    }
    return {name: names for name, names in found.items() if names}


@contextmanager
def followed(
    task_set: SubsystemTasks,
    why: str,
    variables: Mapping[str, str],
    done: Collection[str] = (),
) -> Generator[None]:
    """After the block, re-initialize the users of constants that changed in it.

    Args:
        task_set: The subsystem's tasks.
        why: What the block does, for messages.
        variables: What may change in it, and the RTPU that changes it.
        done: Tasks that the block re-initializes after the change.

    Raises:
        SeveralError: As `renew`. Where the block fails itself it is a warning.
    """
    used = {name for member in task_set.model for name in member.task.needs}
    constants = {name: rtpu for name, rtpu in variables.items() if name in used}
    before = _values(task_set, constants)
    try:
        yield
    except PbonetError:
        try:
            renew(task_set, why, _changed(task_set, constants, before))
        except PbonetError as error:
            task_set.warn([str(error)])
        raise
    renew(task_set, why, _changed(task_set, constants, before), done)


def signals(
    task_set: SubsystemTasks, items: Sequence[tuple[str, str]]
) -> AbstractContextManager[None]:
    """Return `followed` for a list of signals.

    Constants change by ``reinit``, and by ``on`` of a task whose last one failed.
    """
    gives: dict[tuple[str, str], Member] = {}
    for task, signal in items:
        if signal in {"reinit", "on"}:
            one = task_set.model.find(task)
            if one.task.gives and (signal == "reinit" or one.task.needs):
                gives[task, signal] = one
    last = max((items.index(item) for item in gives), default=0)
    homes = {member.rtpu for member in gives.values()}
    done = {
        task
        for task, signal in items[last:]
        if signal == "reinit" and homes <= {task_set.model.find(task).rtpu}
    }
    why = ", ".join(
        f"{kind} of {' and '.join(task for task, signal in gives if signal == kind)}"
        for kind in dict.fromkeys(signal for _, signal in gives)
    )
    variables = {
        name: member.rtpu for member in gives.values() for name in member.task.gives
    }
    return followed(task_set, why, variables, done)


def renew(
    task_set: SubsystemTasks,
    why: str,
    constants: Mapping[str, str],
    done: Collection[str] = (),
) -> None:
    """Re-initialize every task that has these constants as in-consts.

    Tasks that give constants themselves are followed further where a value of theirs
    changes. A failure does not keep the others from the new values.

    Args:
        task_set: The subsystem's tasks.
        why: What happened, for messages: "tool_b gives TOOL_MASS".
        constants: The constants that are new, and the RTPU where each was given.
        done: Tasks that took them in already.

    Raises:
        SeveralError: Some tasks could not take them in; of one, its own error. The
            others did.
    """
    new = dict(constants)
    renewed: list[str] = []
    errors: list[PbonetError] = []
    members = {member.name: member for member in task_set.model} if new else {}
    for name in legality.spawn_order([member.task for member in members.values()]):
        member = members[name]
        held = [one for one in member.task.needs if one in new]
        if not held or name in done:
            continue
        try:
            _arrived(task_set, member, {one: new[one] for one in held})
            gives = dict.fromkeys(member.task.gives, member.rtpu)
            before = _values(task_set, gives)
            task_set.control(name, "reinit", "")
            renewed.append(name)
            new |= _changed(task_set, gives, before)
        except PbonetError as error:
            errors.append(_unrenewed(error, why, held))
    if renewed:
        task_set.warn([f"{why}: re-initialized {', '.join(renewed)}"])
    rpc.raise_all(f"{why}, and {len(errors)} tasks did not take it in", errors)


def _arrived(
    task_set: SubsystemTasks, member: Member, given_at: Mapping[str, str]
) -> None:
    """Wait until constants stand in a task's table as in that of the task giving them.

    Each machine has one table, and a value needs time from one to another.

    Args:
        task_set: The subsystem's tasks.
        member: The task that is to take them in.
        given_at: The constants, and the RTPU where each was given.

    Raises:
        NoAnswerError: They did not come.
        PbonetError: The task's own RTPU does not say what it has.
    """
    near = task_set.clients.share_a_machine
    far = {name: rtpu for name, rtpu in given_at.items() if not near(rtpu, member.rtpu)}
    end = time.monotonic() + ARRIVAL_TIME
    while far:
        try:
            there = _values(task_set, far)
        except PbonetError:  # who gave them cannot be asked: these are the last ones
            return
        here = _values(task_set, dict.fromkeys(far, member.rtpu))
        far = {name: rtpu for name, rtpu in far.items() if there[name] != here[name]}
        if far and time.monotonic() > end:
            raise NoAnswerError(
                f"the constant {' and '.join(far)} has not come here",
                where=f"{member.rtpu}/{member.name}",
                expected=f"the value that {' and '.join({*far.values()})} has, within "
                f"{ARRIVAL_TIME:g} s",
                remedy="check the connection with `pbonet doctor`",
            )
        if far:
            time.sleep(LOOK_TIME)


def _values(task_set: SubsystemTasks, where: Mapping[str, str]) -> dict[str, str]:
    """Return the value of each variable, as text, in the table of an RTPU."""
    found: dict[str, str] = {}
    for rtpu in dict.fromkeys(where.values()):
        names = [name for name, at in where.items() if at == rtpu]
        shown = task_set.clients.call(rtpu, m.Display(names=names), list[m.VarValue])
        found |= {one.name: str(one.values) for one in shown}  # NaN is NaN
    return found


def _changed(
    task_set: SubsystemTasks, where: Mapping[str, str], before: Mapping[str, str]
) -> dict[str, str]:
    now = _values(task_set, where)
    return {name: where[name] for name in before if now[name] != before[name]}


def _unrenewed(error: PbonetError, why: str, held: Collection[str]) -> PbonetError:
    """Return an error that also names the constants with which its task continues."""
    told = f"{why} all the same, and this task has the old {' and '.join(sorted(held))}"
    error.remedy = f"{error.remedy}; {told}" if error.remedy else told
    return error
