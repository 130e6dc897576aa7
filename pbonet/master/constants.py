"""Constants that change under tasks that stand (Stewart 1994, section 3.5).

A task takes its in-consts in when it is created. When another task gives them later, or
when their value changes, whoever took the old one is re-initialized, in the order that
constants demand, so that all tasks deal with the same constants.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

from pbonet import verify
from pbonet.errors import PbonetError
from pbonet.xm import messages as m
from pbonet.xm import rpc

if TYPE_CHECKING:
    from collections.abc import Collection, Generator, Iterable, Sequence

    from pbonet.master.crew import Crew
    from pbonet.master.picture import Member


def given(crew: Crew, task: str, leaving: Collection[str] = ()) -> None:
    """Re-initialize who uses the constants of a task that gives them from now on.

    Args:
        crew: The tasks.
        task: The one that was created, or took them over.
        leaving: Tasks that are about to be killed, and need not know.

    Raises:
        SeveralError: As `renew`; the task gives them all the same.
    """
    gives = crew.picture.find(task).task.gives
    renew(crew, f"{task} gives {' and '.join(gives)}", gives, leaving)


def taken_over(
    coming: Iterable[Member], going: Iterable[Member]
) -> dict[str, list[str]]:
    """Return whose constants tasks give that come in the place of others.

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
    crew: Crew, why: str, variables: Iterable[str], done: Collection[str] = ()
) -> Generator[None]:
    """Re-initialize, behind the block, who uses a constant whose value changed in it.

    Args:
        crew: The tasks.
        why: What the block does, for messages.
        variables: What may change in it.
        done: Tasks that the block re-initializes behind the change.

    Raises:
        SeveralError: As `renew`. Where the block fails itself it is a warning.
    """
    used = {name for member in crew.picture for name in member.task.needs}
    constants = [name for name in dict.fromkeys(variables) if name in used]
    before = _values(crew, constants)
    try:
        yield
    except PbonetError:
        try:
            renew(crew, why, _changed(crew, before))
        except PbonetError as error:
            crew.tell([str(error)])
        raise
    renew(crew, why, _changed(crew, before), done)


def signals(
    crew: Crew, items: Sequence[tuple[str, str]]
) -> AbstractContextManager[None]:
    """Return `followed` for a list of signals.

    Constants change by ``reinit``, and by ``on`` of a task whose last one failed.
    """
    gives: dict[tuple[str, str], tuple[str, ...]] = {}
    for task, signal in items:
        if signal in {"reinit", "on"}:
            one = crew.picture.find(task).task
            if one.gives and (signal == "reinit" or one.needs):
                gives[task, signal] = one.gives
    last = max((items.index(item) for item in gives), default=0)
    done = {task for task, signal in items[last:] if signal == "reinit"}
    why = ", ".join(
        f"{kind} of {' and '.join(task for task, signal in gives if signal == kind)}"
        for kind in dict.fromkeys(signal for _, signal in gives)
    )
    return followed(crew, why, [v for given in gives.values() for v in given], done)


def renew(
    crew: Crew, why: str, constants: Iterable[str], done: Collection[str] = ()
) -> None:
    """Re-initialize every task that has these constants as in-consts.

    Tasks that give constants themselves are followed further where a value of theirs
    changes. One that fails keeps nobody else from the new values.

    Args:
        crew: The tasks.
        why: What happened, for messages: "tool_b gives TOOL_MASS".
        constants: The constants that are new.
        done: Tasks that took them in already.

    Raises:
        SeveralError: Some tasks could not take them in; of one, its own error. The
            others did.
    """
    new = set(constants)
    renewed: list[str] = []
    errors: list[PbonetError] = []
    tasks = {member.name: member.task for member in crew.picture} if new else {}
    for name in verify.spawn_order(list(tasks.values())):
        held = new.intersection(tasks[name].needs)
        if not held or name in done:
            continue
        try:
            before = _values(crew, tasks[name].gives)
            crew.control(name, "reinit", "")
            renewed.append(name)
            new |= _changed(crew, before)
        except PbonetError as error:
            errors.append(_unrenewed(error, why, held))
    if renewed:
        crew.tell([f"{why}: re-initialized {', '.join(renewed)}"])
    rpc.raise_all(f"{why}, and {len(errors)} tasks did not take it in", errors)


def _values(crew: Crew, names: Sequence[str]) -> dict[str, list[float] | bytes]:
    if not names:
        return {}
    request = m.Display(names=list(names))
    shown = crew.fleet.call(crew.files.sbs.keeper, request, list[m.VarValue])
    return {value.name: value.values for value in shown}


def _changed(crew: Crew, before: dict[str, list[float] | bytes]) -> set[str]:
    now = _values(crew, list(before))
    return {name for name in before if now[name] != before[name]}


def _unrenewed(error: PbonetError, why: str, held: Collection[str]) -> PbonetError:
    """Return an error that also says what its task goes on believing."""
    told = f"{why} all the same, and this task has the old {' and '.join(sorted(held))}"
    error.remedy = f"{error.remedy}; {told}" if error.remedy else told
    return error
