"""Assembling a whole job in two phases, undoing it when a step fails, and its end.

First every task is spawned, in the order that constants demand (Stewart 1994, section
3.5), until all are OFF; then they are turned ON: sensors, computation, and at last the
CRITICAL tasks, which drive hardware and so find their inputs flowing.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from pbonet.analysis import legality
from pbonet.errors import PbonetError, SeveralError, StateError, UnknownTaskError
from pbonet.master.configuration import failed_at_end, forced
from pbonet.pbo import State
from pbonet.versions import REMEDY
from pbonet.xm.net import messages as m, rpc

from . import constants
from .condition_gate import ConditionGate

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Collection, Generator, Sequence

    from pbonet.config import JobFile, JobTask
    from pbonet.master.configuration import Member

    from .subsystem_tasks import SubsystemTasks


def plan(task_set: SubsystemTasks, job: JobFile) -> list[Member]:
    """Return the job's tasks as they would be spawned.

    Raises:
        PbonetError: RMODs, RTPUs or modules are missing or wrong; all are named.
    """
    members: list[Member] = []
    errors: list[PbonetError] = []
    for task in job.tasks:
        try:
            source = task_set.files.rmod(task.rmod, task.freq)
            member = task_set.plan(source, task.rtpu, task.freq)
        except PbonetError as error:
            if not error.where or task.rtpu not in {None, *task_set.clients.names}:
                error.where = str(task.place or job.file)
            errors.append(error)
            continue
        member.restart, member.job_places = task.restart, task.job_places
        members.append(member)
        try:
            members += _fallback(task_set, task, member)
        except PbonetError as error:
            error.where = error.where or str(task.place or job.file)
            errors.append(error)
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise SeveralError(f"the job {job.name} cannot be assembled", errors)
    return members


def _fallback(
    task_set: SubsystemTasks, task: JobTask, original: Member
) -> list[Member]:
    """Return the standby of a task, to be spawned where its RMOD says.

    Without that it is on the RTPU of its original.

    Raises:
        PbonetError: Its RMOD or module is missing or wrong.
    """
    if task.fallback is None:
        return []
    source = task_set.files.rmod(task.fallback)
    member = task_set.plan(source, source.record.rtpu or original.rtpu, None)
    member.fallback_of, member.takeover = original.name, task.takeover
    member.restart = task.restart
    if task.place:
        member.job_places = {"TASK": task.place}
    member.original_rtpu = original.rtpu if original.rtpu != member.rtpu else ""
    return [member]


def change(task_set: SubsystemTasks, job: JobFile) -> legality.Change:
    """Return the change that a start of the job makes, to be judged.

    Raises:
        PbonetError: RMODs, RTPUs or modules are missing or wrong; all are named.
    """
    return legality.job([member.task for member in plan(task_set, job)])


def start(
    task_set: SubsystemTasks,
    job: JobFile,
    stopped: threading.Event,
    halted: Callable[[], bool] | None = None,
) -> list[m.TaskStatus]:
    """Assemble a job; return the status of its tasks.

    Args:
        task_set: The subsystem's tasks.
        job: What to assemble; its PRE must hold, before and when all tasks are there.
        stopped: When it is set, the assembly gives up and is undone.
        halted: Tells whether a stop has come since the start was wanted; None: none can
            have.

    Raises:
        VerificationError: It would be illegal; nothing was done.
        ConditionError: A condition does not hold; nothing was done.
        PbonetError: A step failed; what was done was undone.
    """
    gate = ConditionGate(task_set, job, leaves=False, halted=halted)
    wanted = plan(task_set, job)
    tasks = [member.task for member in wanted]
    problems = task_set.legal(legality.job(tasks))
    gate.must_hold()
    task_set.say(problems)
    infos = task_set.clients.infos()
    task_set.warn(f"{text} ({REMEDY})" for text in m.mismatched(infos))
    task_set.warn(f"{text} ({m.HELD_REMEDY})" for text in m.held(infos))
    by_name = {member.name: member for member in wanted}
    done = Done(task_set)
    with done.undone_on_error(f"the job {job.name} did not start"):
        for step in legality.spawn_steps(tasks):
            go_on(stopped)
            wanted_now = [by_name[name] for name in step]
            done.spawn_all([one for one in wanted_now if not stands(task_set, one)])
        task_set.rank()
        gate.must_hold()
        pair(task_set, wanted)  # before a task that has a standby may fail
        for name in legality.on_order([one for one in tasks if not one.fallback_of]):
            go_on(stopped)
            if not task_set.model.find(name).is_on:
                done.turn_on(name)
        pair(task_set, wanted)
        gate.entered()
    part(
        task_set, [two for two in unpaired(task_set, wanted) if replaced(wanted, *two)]
    )
    statuses = [status for rtpu in task_set.refresh() for status in rtpu.tasks]
    return [status for status in statuses if status.task in by_name]


def end(task_set: SubsystemTasks, name: str) -> list[PbonetError]:
    """Turn OFF in order, end every task, give everything back.

    Args:
        task_set: The subsystem's tasks.
        name: Its name, for errors.

    Returns:
        An error for each task that hung, and was ended by force, and for each that
        failed in its `off` or `kill`, or died.

    Raises:
        SeveralError: Parts of it could not be done, the rest was; of one part, its own
            error.
    """
    refused = task_set.off()
    still_on = [member for member in task_set.model if member.is_on]
    stopped, errors, _ = task_set.stop()
    silent = {error.where for error in errors}
    for member, error in refused:
        obeyed = member.name in {*stopped.off, *stopped.killed}
        if member.rtpu not in silent and not obeyed:
            cause = error.__cause__
            what = cause.what if isinstance(cause, PbonetError) else error.what
            stopped.failed.setdefault(member.name, f"off: {what}")
    told = {str(error) for error in errors}
    errors += [error for error in task_set.leave() if str(error) not in told]
    ended = [forced(one) for one in still_on if one.name in stopped.killed]
    ended += failed_at_end(stopped)
    if errors:
        what = f"the end of subsystem {name} is incomplete"
        rpc.raise_all(what, [*errors, *ended])
    return ended


def pair(task_set: SubsystemTasks, wanted: Sequence[Member]) -> None:
    """Have the standbys of a job stand by for their originals.

    Raises:
        PbonetError: One could not take over.
    """
    for member in wanted:
        if member.fallback_of:
            task_set.standbys.name(member.name, member.fallback_of, member.takeover)


def unpaired(
    task_set: SubsystemTasks, wanted: Sequence[Member]
) -> list[tuple[Member, str]]:
    """Return tasks that are fallbacks but not in this job, each with its original."""
    standbys = {member.name for member in wanted if member.fallback_of}
    return [
        (member, member.fallback_of)
        for member in task_set.model
        if member.fallback_of and member.name not in standbys
    ]


def replaced(wanted: Sequence[Member], standby: Member, original: str) -> bool:
    """Return whether a job has a standby as a task, or another one for its original.

    A job that comes beside others takes no fallback from a task by not naming it.
    """
    return any(
        standby.name == one.name or original == one.fallback_of for one in wanted
    )


def part(task_set: SubsystemTasks, pairs: Sequence[tuple[Member, str]]) -> None:
    """Have tasks be the fallbacks of others no more; what fails is a warning."""
    for member, original in pairs:
        try:
            task_set.standbys.name(member.name, "")
        except UnknownTaskError:
            continue  # it has died, or a stop was quicker
        except PbonetError as error:
            task_set.warn([
                f"{member.name} is still the fallback of {original}: {error}"
            ])


class Done:
    """Steps done so far, and how each is undone."""

    def __init__(self, task_set: SubsystemTasks) -> None:
        self._task_set = task_set
        self._spawned: list[str] = []
        self._on: list[str] = []
        self._robbed: dict[str, str] = {}

    @contextmanager
    def undone_on_error(self, what: str) -> Generator[None]:
        """If the block fails, undo its changes.

        Args:
            what: What has failed then, for the error.

        Raises:
            SeveralError: It failed, and not all could be undone.
        """
        with self._task_set.interrupts("undoing what was begun") as interrupts:
            try:
                yield
            except BaseException as error:
                interrupts.wait()
                left = self.undo()
                if left and isinstance(error, PbonetError):
                    raise SeveralError(
                        f"{what}, and not all could be undone",
                        [error, *left],
                        remedy="'stop' ends the remaining tasks",
                    ) from error
                raise

    def spawn(
        self,
        member: Member,
        replaces: Sequence[str] = (),
        leaving: Collection[str] = (),
    ) -> None:
        """Create a task.

        Args:
            member: The task.
            replaces: Tasks whose constants it takes over.
            leaving: Tasks that are about to be killed, and need no new constants.
        """
        constants.at_hand(self._task_set, member)
        self._task_set.create(member, replaces)
        self._spawned.append(member.name)
        self._robbed |= dict.fromkeys(replaces, member.name)
        constants.given(self._task_set, member.name, leaving)

    def spawn_all(self, members: Sequence[Member]) -> None:
        """Create tasks at once, each on an RTPU of its own.

        Raises:
            SeveralError: Some could not be created; of one, its own error.
        """
        for member in members:
            constants.at_hand(self._task_set, member)
        created, errors = self._task_set.create_all(members)
        self._spawned += created
        rpc.raise_all(f"{len(errors)} tasks could not be created", errors)
        for name in created:
            constants.given(self._task_set, name)

    def give(
        self, name: str, replaces: Sequence[str], leaving: Collection[str]
    ) -> None:
        """Let an existing task produce constants instead of others, as `spawn` does."""
        self._task_set.control(name, "reinit", "", replaces)
        self._robbed |= dict.fromkeys(replaces, name)
        constants.given(self._task_set, name, leaving)

    def turn_on(self, name: str) -> None:
        """Turn a task on."""
        self._on.append(name)  # first: Ctrl-C may end the wait for the answer
        self._task_set.control(name, "on", "")

    def undo(self) -> list[PbonetError]:
        """Turn off and kill, the last first; return what could not be done."""
        errors: list[PbonetError] = []
        steps = [(name, "off") for name in reversed(self._on)]
        steps += [(name, "kill") for name in reversed(self._spawned)]
        for name, signal in steps:
            try:
                self._task_set.refresh(strict=False)
                member = self._task_set.model.get(name)
                if member is not None and (signal == "kill" or member.is_on):
                    self._task_set.control(name, signal, "")
            except UnknownTaskError:
                continue  # a stop was quicker
            except PbonetError as error:
                errors.append(error)
        return [*errors, *self._restore()]

    def _restore(self) -> list[PbonetError]:
        """Have those give their constants again that lost them; return what failed."""
        errors: list[PbonetError] = []
        for old, new in reversed(self._robbed.items()):
            try:
                self._task_set.control(old, "reinit", "", [new])
                constants.given(self._task_set, old)
            except PbonetError as error:
                errors.append(error)
        return errors


def stands(task_set: SubsystemTasks, member: Member) -> bool:
    """Return whether the task is there already, made from the same RMOD on its RTPU.

    Raises:
        StateError: A task of that name is there, but another one, or in ERROR.
    """
    old = task_set.model.get(member.name)
    if old is None:
        return False
    same = old.source.text == member.source.text
    if same and old.rtpu == member.rtpu and old.state is not State.ERROR:
        if old.restart != member.restart:
            task_set.warn([
                f"{old.name} keeps RESTART {old.restart}, with which it was spawned; "
                f"for RESTART {member.restart} kill it first"
            ])
        return True
    raise StateError(
        f"the task {old.name} is in the way",
        where=f"{old.rtpu}/{old.name}",
        expected=f"none, or one of the same RMOD on {member.rtpu} without error",
        got=f"state {old.state}, {'the same' if same else 'another'} RMOD "
        f"on {old.rtpu}",
        remedy=f"'clear {old.name}' brings it out of ERROR, "
        * (same and old.state is State.ERROR)
        + f"'kill {old.name}' removes it",
    )


def go_on(stopped: threading.Event) -> None:
    """Continue, unless a stop was requested.

    Raises:
        StateError: A stop was requested.
    """
    if stopped.is_set():
        raise StateError(
            "the start was abandoned because of a stop",
            remedy="start it again; what was begun was undone",
        )
