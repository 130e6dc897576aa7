"""Judges a change: all checks, and which problems are only warnings.

A job and a reconfiguration list are judged by the configuration they end in. A single
signal is judged by what it makes worse: turning a task ON may leave inputs without a
writer, because a loop that is built by hand does, but may not give a variable a second
writer. Turning off, killing and stopping are never refused.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.errors import VerificationError, did_you_mean

from .devices_on_rtpus import check_names
from .freshness import check_circles
from .joins import check_ages, check_units
from .misspelled_ports import as_meant
from .order import check_initialization
from .parts import check_ports, check_task
from .records import Code, Configuration, Problem, Severity, Task
from .safety import check_safety
from .shapes import check_shapes
from .takeover import check_standbys
from .times import check_times
from .timing import check_loads
from .traffic import check_traffic
from .wiring import check_constants, check_readers, check_writers

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

ENDING = frozenset({"off", "kill", "stop"})
"""Signals that are never refused for legality."""
_STARTING = frozenset({"spawn", "on", "freq"})


class Change(Struct, frozen=True, kw_only=True):
    """A change of a configuration; made by the functions below."""

    items: tuple[tuple[str, str], ...]
    """Pairs of task and signal, in order: ``spawn on off kill freq`` and others."""
    whole: bool
    """A job or a list, which is judged by its end."""
    tasks: tuple[Task, ...] = ()
    """Tasks to be spawned, and those that get another frequency."""
    replaced: frozenset[str] = frozenset()
    """Tasks whose constants others give from then on."""


def job(tasks: Sequence[Task]) -> Change:
    """Return the change that spawns all and turns on those that do not stand by."""
    items = [(task.name, "spawn") for task in tasks]
    items += [(task.name, "on") for task in tasks if not task.fallback_of]
    return Change(items=tuple(items), whole=True, tasks=tuple(tasks))


def reconfig(
    items: Iterable[tuple[str, str]],
    tasks: Sequence[Task] = (),
    replaces: Mapping[str, Sequence[str]] | None = None,
) -> Change:
    """Return the change of an ordered list.

    Args:
        items: Pairs of task and signal, in order.
        tasks: Those that it spawns.
        replaces: Tasks, and for each those whose constants it gives from then on.
    """
    replaced = frozenset(old for olds in (replaces or {}).values() for old in olds)
    return Change(items=tuple(items), whole=True, tasks=tuple(tasks), replaced=replaced)


def signal(task: str, name: str) -> Change:
    """Return the change that one signal to an existing task makes."""
    return Change(items=((task, name),), whole=False)


def spawn(task: Task) -> Change:
    """Return the change of spawning one task."""
    return Change(items=((task.name, "spawn"),), whole=False, tasks=(task,))


def frequency(task: Task) -> Change:
    """Return the change of an existing task to the frequency of `task`."""
    return Change(items=((task.name, "freq"),), whole=False, tasks=(task,))


class Verdict(Struct, frozen=True, kw_only=True):
    """The verdict on a change."""

    after: Configuration
    """The configuration that it ends in."""
    problems: tuple[Problem, ...]

    @property
    def refused(self) -> tuple[Problem, ...]:
        """The problems for which it is refused; empty when it may be made."""
        return tuple(p for p in self.problems if p.severity is Severity.REFUSE)

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """The problems that are only reported."""
        return tuple(p for p in self.problems if p.severity is Severity.WARN)

    def check(self) -> None:
        """Raise if the change is refused.

        Raises:
            VerificationError: It is; the message has every reason.
        """
        if self.refused:
            raise as_error(self.refused)


def check(configuration: Configuration) -> list[Problem]:
    """Return everything that is wrong with a configuration (section 3.3.1)."""
    found = [p for task in configuration.tasks for p in check_ports(task)]
    configuration = as_meant(configuration)
    found += [p for t in configuration.tasks for p in check_task(configuration, t)]
    found += [p for task in configuration.tasks for p in check_times(task)]
    for part in (
        check_shapes,
        check_writers,
        check_readers,
        check_constants,
        check_ages,
        check_circles,
        check_safety,
        check_standbys,
        check_units,
        check_initialization,
        check_loads,
        check_traffic,
    ):
        found += part(configuration)
    return found + _with_fallbacks(configuration, found)


_OF_STANDBYS = (check_writers, check_readers, check_circles, check_safety, check_loads)
"""Checks of tasks that are ON, which a standby must pass before it is."""


def _with_fallbacks(now: Configuration, found: Sequence[Problem]) -> list[Problem]:
    """Return the problems there would be once a standby replaces its original.

    Each pair is judged by itself, and of several the load of all standbys at once; an
    original and its standby are never ON together.
    """
    pairs = {
        task.name: task.fallback_of
        for task in now.tasks
        if task.fallback_of in now.on and task.name not in now.on
    }
    known = {problem.key for problem in found}
    told: list[Problem] = []
    for standby, original in pairs.items():
        then = structs.replace(now, on=now.on - {original} | {standby})
        for part in _OF_STANDBYS:
            told += [
                _once(p, f"{standby} is in the place of {original}") for p in part(then)
            ]
    if len(pairs) > 1:
        then = structs.replace(now, on=now.on - {*pairs.values()} | pairs.keys())
        told += [_once(p, "every fallback is engaged") for p in check_loads(then)]
    new: dict[tuple[object, ...], Problem] = {}
    for problem in told:
        if problem.key not in known:
            new.setdefault(problem.key, problem)
    return list(new.values())


def _once(problem: Problem, when: str) -> Problem:
    return structs.replace(problem, what=f"{problem.what}, once {when}")


def judge(current: Configuration, change: Change) -> Verdict:
    """Return the verdict on a change of the present configuration."""
    problems: list[Problem] = []
    after = current
    known = (*current.tasks, *change.tasks)
    shared = _shared(known)
    contested = {task.name for task in known if not shared.isdisjoint(_out(task))}
    given = {task.name: task for task in change.tasks}
    for name, sent in change.items:
        step = _step(after, given.get(name), name, sent)
        if step is None:
            problems.append(_unknown(after, name, sent))
        else:
            after = step
            if change.whole and sent == "on" and name in contested:
                problems += _passing(after, name)
    standing = {task.name for task in current.tasks}
    new = [task for task in change.tasks if task.name not in standing]
    end = [*check(after), *check_names(current, new)]
    final = {problem.key for problem in end}
    problems = [problem for problem in problems if problem.key not in final] + end
    if not {sent for _, sent in change.items} & _STARTING:
        problems = [_as_warning(problem) for problem in problems]
    elif not change.whole:
        before = {problem.key for problem in check(current)}
        problems = [
            _as_warning(p) if p.key in before or p.code is Code.NO_WRITER else p
            for p in problems
        ]
    problems = _unsettled(problems, current, change.replaced - after.on)
    return Verdict(after=after, problems=tuple(problems))


def _unsettled(
    problems: list[Problem], current: Configuration, replaced: frozenset[str]
) -> list[Problem]:
    """Leave out tasks that share a constant if their values are known to be equal.

    Of those that stand the table has compared the values, and one that is replaced
    gives its constants no more.
    """
    if not any(problem.code is Code.TWO_CONSTANTS for problem in problems):
        return problems
    stood = [
        ({*one.tasks}, one.variables)
        for one in check_writers(as_meant(current))
        if one.code is Code.TWO_CONSTANTS
    ]

    def settled(problem: Problem) -> bool:
        left = {*problem.tasks} - replaced
        return len(left) == 1 or any(
            left <= tasks and problem.variables == variables
            for tasks, variables in stood
        )

    return [p for p in problems if p.code is not Code.TWO_CONSTANTS or not settled(p)]


def _as_warning(problem: Problem) -> Problem:
    return structs.replace(problem, severity=Severity.WARN)


def _step(
    now: Configuration, given: Task | None, name: str, sent: str
) -> Configuration | None:
    """Return the configuration after one signal, None if it knows no such task."""
    known = name in now.task_names
    if given is not None and (sent == "spawn" or (sent == "freq" and known)):
        tasks = tuple(given if task.name == name else task for task in now.tasks)
        return structs.replace(now, tasks=tasks if known else (*tasks, given))
    if not known:
        return None
    on = now.on | {name} if sent == "on" else now.on
    if sent in ENDING:
        on -= {name}
    tasks = now.tasks
    if sent in {"kill", "stop"}:
        tasks = tuple(task for task in tasks if task.name != name)
    return structs.replace(now, on=on, tasks=tasks)


def _passing(after: Configuration, name: str) -> list[Problem]:
    """Return second writers that a list has in passing, when it turns `name` on."""
    found: list[Problem] = []
    for problem in check_writers(after):
        if problem.code is Code.TWO_WRITERS and name in problem.tasks:
            others = [task for task in problem.tasks if task != name]
            found.append(
                structs.replace(
                    problem,
                    severity=Severity.WARN,
                    what=f"{problem.what} while the list is carried out",
                    remedy=f"turn {' and '.join(others)} off before {name} is turned "
                    "on, else the table refuses the second writer",
                )
            )
    return found


def _out(task: Task) -> tuple[str, ...]:
    """Return all that a task writes."""
    return (*task.outputs, *task.gives)


def _shared(tasks: Iterable[Task]) -> set[str]:
    """Return the variables and constants that more than one of the tasks can write."""
    count = Counter(name for task in tasks for name in _out(task))
    return {name for name, times in count.items() if times > 1}


def _unknown(now: Configuration, name: str, sent: str) -> Problem:
    names = [task.name for task in now.tasks]
    return Problem(
        code=Code.UNKNOWN_TASK,
        severity=Severity.WARN if sent in ENDING else Severity.REFUSE,
        what=f"there is no task {name} to send {sent} to",
        where=name,
        expected=" or ".join(names) or "a task that was spawned",
        got=name,
        remedy=did_you_mean(name, names) or f"spawn {name} first",
        tasks=(name,),
    )


def as_text(problem: Problem) -> str:
    """Return the whole problem on one line, in the form of its error."""
    return str(_error(problem))


def _error(problem: Problem) -> VerificationError:
    return VerificationError(
        problem.what,
        where=problem.where,
        expected=problem.expected,
        got=problem.got,
        remedy=problem.remedy,
    )


def as_error(problems: Sequence[Problem]) -> VerificationError:
    """Return one error for all problems; several are a numbered list."""
    if len(problems) == 1:
        return _error(problems[0])
    lines = [f"{n}. {as_text(problem)}" for n, problem in enumerate(problems, 1)]
    return VerificationError(
        f"{len(problems)} faults make the configuration illegal:\n" + "\n".join(lines)
    )
