"""Standbys in virtual time: engaged by the dispatcher's own rules, at the same instant.

A pair is arranged as `fallbacks` arranges it on an RTPU, while the original
is ON and the standby OFF, and as often. Nothing dies here; an original falls by ERROR.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.analysis.schedule import SLOTS
from pbonet.config import JobTask
from pbonet.errors import PbonetError, Severity, StateError
from pbonet.node.rtpu import LIMIT, Pair, rtpu_snapshot
from pbonet.pbo import State

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from pbonet.master.configuration import Member

    from .sim_task import SimTask, Turns


def members(plan: Callable[[JobTask], Member], task: JobTask) -> list[Member]:
    """Return a task of a job as `plan` makes it, and behind it its fallback."""
    original = plan(task)
    if task.fallback is None:
        return [original]
    rmod, rtpu = task.fallback, original.rtpu
    standby = plan(JobTask(rmod=rmod, rtpu=rtpu, place=task.place))
    standby.fallback_of = original.name
    return [original, standby]


class Standbys:
    """The pairs of one simulation.

    Args:
        subsystem: Whose.
        tasks: Every task by its name, as they come and go.
        turns: The releases of each RTPU.
        signal: Sends a signal to a task.
        tell: Tells what came of it when a standby was engaged.
    """

    def __init__(
        self,
        subsystem: str,
        tasks: Mapping[str, SimTask],
        turns: Mapping[str, Turns],
        *,
        signal: Callable[[str, str], State],
        tell: Callable[[SimTask, Severity, str], None],
    ) -> None:
        self._subsystem, self._tasks, self._turns = subsystem, tasks, turns
        self._signal, self._tell = signal, tell
        self._pairs: dict[str, Pair] = {}

    def begin(self, members: Iterable[Member]) -> None:
        """Have the standbys of a job stand by for their originals."""
        for member in members:
            if member.fallback_of:
                self.pair(self._tasks[member.name], self._tasks[member.fallback_of])

    def pair(self, standby: SimTask, original: SimTask | None) -> None:
        """Make a task the fallback of another one; None ends that.

        Raises:
            UnknownTaskError: The other one is on another RTPU.
            StateError: They are the same task, or it cannot be watched.
        """
        rtpu = standby.member.rtpu
        if original and original.member.rtpu != rtpu:
            here = [one.name for one in self._tasks.values() if one.member.rtpu == rtpu]
            raise rtpu_snapshot.no_task(
                rtpu, self._subsystem, original.name, here, None
            )
        if original and (original is standby or original.slot >= SLOTS):
            raise StateError(
                f"the task {standby.name} cannot be the fallback of {original.name}",
                where=original.member.rtpu,
                expected=f"another one, of the first {SLOTS} that were spawned",
                remedy="name another task, or begin the simulation anew",
            )
        self.dismiss(standby)
        self._pairs.pop(standby.name, None)
        standby.member.fallback_of = original.name if original else ""
        if original is None:
            return
        self._pairs[standby.name] = Pair(self._subsystem, original.name, standby.name)
        self.look()

    def forget(self, names: set[str] | None = None) -> None:
        """Forget the pairs of these standbys, or all: they are ended."""
        for name in names if names is not None else set(self._pairs):
            if name in self._tasks:
                self.dismiss(self._tasks[name])
            self._pairs.pop(name, None)

    def look(self) -> None:
        """Arrange or dissolve pairs, as the state of a task has changed."""
        for pair in self._pairs.values():
            standby = self._tasks.get(pair.standby)
            original = self._tasks.get(pair.original)
            if standby is None:
                continue
            now = original.executor.state if original else State.NOT_CREATED
            if standby.stands_by:
                if now not in {State.ON, State.ERROR}:
                    self.dismiss(standby)
            elif (
                original is not None
                and original.member.rtpu == standby.member.rtpu
                and now is State.ON
                and standby.executor.state is State.OFF
                and pair.engaged < LIMIT
            ):
                standby.stands_by = original.name
                self._turns[standby.member.rtpu].stand_by(standby, original)

    def dismiss(self, task: SimTask) -> None:
        """Have a task stand by no longer, if it does: it gets a signal itself."""
        if task.stands_by:
            task.stands_by = ""
            self._turns[task.member.rtpu].rest(task)

    def missed(self, task: SimTask) -> set[str]:
        """Return which of its variables others must write when a task has failed.

        Where its fallback is ON these are what both write: the configuration was judged
        with the one in the place of the other.
        """
        outputs = set(task.member.task.outputs)
        for pair in self._pairs.values():
            other = self._tasks.get(pair.standby)
            if pair.original != task.name or other is None:
                continue
            if other.executor.state is State.ON:
                outputs &= set(other.member.task.outputs)
        return outputs

    def engage(self, task: SimTask) -> None:
        """Turn a task on in the place of its original, and tell so."""
        pair = self._pairs[task.name]
        task.stands_by, failed = "", ""
        pair.engaged += 1
        try:
            state = self._signal(task.name, "on")
        except PbonetError as error:
            state, failed = task.executor.state, f"{error}"
        good = state is State.ON
        if not good:
            self._turns[task.member.rtpu].rest(task)
        self._tell(
            task,
            Severity.WARNING if good else Severity.ERROR,
            f"{pair.original} is in ERROR: its fallback {task.name} was released by "
            f"the dispatcher; state {state}, time {pair.engaged} of {LIMIT}"
            + ("" if good else f"; nobody writes its variables: {failed}")
            + (f"; {task.name} will not stand by again" * (pair.engaged >= LIMIT)),
        )
