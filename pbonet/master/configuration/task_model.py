"""The tasks of a subsystem as its master knows them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis import legality
from pbonet.errors import UnknownTaskError, did_you_mean
from pbonet.pbo import State

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.config import Place, Rmod
    from pbonet.pbo import ModuleInfo
    from pbonet.xm.net import Restart

    from .saved_profiles import Saved
    from .subsystem_files import RmodSource


class Member(Struct, kw_only=True):
    """A task of the subsystem, existing or planned."""

    source: RmodSource
    rtpu: str
    freq: float
    """Hz; 0 where the task has no rate of its own."""
    state: State = State.NOT_CREATED
    info: ModuleInfo | None = None
    """Of its module; None while no agent was asked."""
    job_places: Mapping[str, Place] = {}
    """As in `verify.Task`."""
    saved: Saved | None = None
    """Its saved profile on its machine, if there is one."""
    fallback_of: str = ""
    """The task for which it stands by."""
    restart: Restart = "off"
    """Treatment by its agent when the RTPU process or the machine was lost."""
    original_rtpu: str = ""
    """The RTPU of that task, if it is another one."""
    takeover: float = 0.0
    """As in `verify.Task`."""

    @property
    def name(self) -> str:
        """The task's name: that of its RMOD."""
        return self.source.record.name

    @property
    def rmod(self) -> Rmod:
        """The record of its RMOD."""
        return self.source.record

    @property
    def is_on(self) -> bool:
        """Whether it writes its variables."""
        return self.state is State.ON

    @property
    def task(self) -> legality.Task:
        """The task in the form that verification uses."""
        from .saved_profiles import with_times

        task = legality.Task(
            rmod=self.rmod,
            info=self.info,
            rtpu=self.rtpu,
            freq=self.freq or None,
            job_places=self.job_places,
            fallback_of=self.fallback_of,
            takeover=self.takeover,
            restart=self.restart,
        )
        return with_times(task, self.saved)

    @property
    def variables(self) -> set[str]:
        """The variables of all its ports."""
        task = self.task
        return {*task.inputs, *task.outputs, *task.needs, *task.gives}


class TaskModel:
    """The tasks of a subsystem in the order in which they were spawned."""

    def __init__(self) -> None:
        self._members: dict[str, Member] = {}
        self.killed: set[str] = set()
        """Tasks that were killed by order, and not spawned again."""

    def __iter__(self) -> Iterator[Member]:
        return iter(list(self._members.values()))  # others may read meanwhile

    def __contains__(self, task: str) -> bool:
        return task in self._members

    def __len__(self) -> int:
        return len(self._members)

    @property
    def names(self) -> list[str]:
        """The names of the tasks."""
        return list(self._members)

    def get(self, task: str) -> Member | None:
        """Return a task, or None."""
        return self._members.get(task)

    def find(self, task: str) -> Member:
        """Return a task.

        Raises:
            UnknownTaskError: There is none of that name.
        """
        member = self._members.get(task)
        if member is None:
            there = ", ".join(self._members) or "none"
            raise UnknownTaskError(
                f"the subsystem has no task {task}",
                got=f"tasks: {there}",
                remedy=did_you_mean(task, self._members) or "'spawn' creates one",
            )
        return member

    def add(self, member: Member) -> None:
        """Add a task, or replace the one of the same name."""
        self._members[member.name] = member

    def spawned(self, member: Member) -> None:
        """Add a task that was spawned just now."""
        self.killed.discard(member.name)
        self.add(member)

    def ordered(self, task: str, signal: str) -> None:
        """Take in that a task has carried out an order."""
        if signal == "kill":
            self.killed.add(task)

    def move(self, task: str, state: State) -> None:
        """Take in that a task has come to a state; harmless when there is none."""
        member = self._members.get(task)
        if member is not None and state is State.NOT_CREATED:
            self.remove(task)
        elif member is not None:
            member.state = state

    def remove(self, task: str) -> None:
        """Forget a task; harmless when there is none."""
        self._members.pop(task, None)
