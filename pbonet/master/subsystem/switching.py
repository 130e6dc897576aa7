"""Change from one configuration to another while it runs (Stewart 1994, section 3.10).

What is to be done follows from the two configurations: tasks that both have stay ON, as
A and D do in Figure 3.1; tasks that only the new one has are spawned first, which takes
longest and disturbs no task; then one list of signals exchanges the others, and at the
end the tasks that are no longer wanted are killed.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis import legality
from pbonet.errors import StateError, VerificationError
from pbonet.pbo import State

from . import assembly, constants
from .first_cycle_check import prove

if TYPE_CHECKING:
    import threading
    from collections.abc import Generator, Sequence

    from pbonet.config import JobFile
    from pbonet.master.configuration import Clock, Member

    from .condition_gate import ConditionGate
    from .subsystem_tasks import SubsystemTasks

_RATE = 1e-6
"""Relative difference below which two frequencies are the same."""


class Transition(Struct, kw_only=True):
    """The steps from one configuration to another, and their results."""

    stays: list[str]
    """Tasks that stay ON, untouched."""
    spawns: dict[str, str]
    """Tasks that are created, and on which RTPU, in the order constants demand."""
    items: list[tuple[str, str]]
    """Pairs of task and signal, in order."""
    kills: list[str]
    """Tasks that are destroyed at the end."""
    replaces: dict[str, list[str]] = {}
    """Tasks that come, and those whose constants they give from then on; who uses them
    is re-initialized."""
    conditions: list[str] = []
    """Values seen for the conditions under which jobs are left and entered."""
    states: dict[str, str] = {}
    """The states of the tasks concerned afterwards; empty while nothing was done."""


def carry_out(
    task_set: SubsystemTasks,
    plan: Plan,
    clock: Clock,
    stopped: threading.Event,
    gate: ConditionGate | None = None,
    *,
    dry_run: bool,
) -> Transition:
    """Verify a plan and carry it out; with `dry_run` only verify it.

    Raises:
        PbonetError: It would be illegal, or a step failed.
    """
    with plan.supposed():
        transition = plan.transition()
        problems = task_set.legal(plan.change(transition))
        if gate is not None:
            transition.conditions = gate.must_hold()
    if dry_run:
        task_set.warn(map(legality.as_text, problems))
        return transition
    try:
        task_set.say(problems)
        with plan.supposed():
            plan.spawn(transition, stopped, gate)
        items = transition.items
        transition.states = task_set.send(task_set.order_lost(items))
        plan.pair()
        if kills := [(name, "kill") for name in transition.kills]:
            came = prove(task_set, items, kills, clock, stopped)
            transition.states |= came
            transition.states |= task_set.send(kills, before=items)
    finally:
        task_set.settle()
    return transition


class Plan:
    """Which tasks leave and which come."""

    def __init__(self, task_set: SubsystemTasks) -> None:
        self._task_set = task_set
        self._going: dict[str, Member] = {}
        self._coming: dict[str, Member] = {}
        self._killed: list[str] = []
        self._standbys: dict[str, Member] = {}
        self._kept: set[str] = set()
        """Standbys of tasks that leave."""
        self._originals: list[tuple[Member, str]] = []
        """Tasks, and for whom each is to stand by."""
        self._parted: list[tuple[Member, str]] = []
        """Tasks, and whose fallbacks they no longer are."""
        self._begun = False

    def take_out(self, members: Sequence[Member], *, but: Sequence[str] = ()) -> None:
        """Turn tasks off, except those that are named."""
        self._going |= {one.name: one for one in members if one.name not in but}

    def put_in(self, member: Member) -> None:
        """Turn a task on, and spawn it first if needed; harmless if it is ON."""
        if not member.is_on:
            self._coming[member.name] = member

    def have_ready(self, member: Member, original: str) -> None:
        """Make a standby ready, and spawn it first if needed.

        Args:
            member: The standby. Whose fallback it has been until now keeps it as long
                as that one is ON.
            original: Whose fallback it is to be.
        """
        self._standbys[member.name] = member
        other = self._task_set.model.get(member.fallback_of)
        if member.fallback_of != original and other is not None and other.is_on:
            self._kept.add(member.name)

    def pair_with(self, member: Member, original: str) -> None:
        """Have a task be the fallback of another one, or with "" of none."""
        self._originals.append((member, original))

    def part(self, member: Member, original: str) -> None:
        """Have a task be the fallback of another one no more.

        It is until the change is made; who comes in its place waits as long.
        """
        other = self._task_set.model.get(original)
        if other is not None and other.is_on:
            self._kept |= {one.name for one, of in self._originals if of == original}
        self._parted.append((member, original))
        self._originals.append((member, ""))

    @contextmanager
    def supposed(self) -> Generator[None]:
        """Set in the model which tasks stand by; undo it if nothing is started."""
        before = [(member, member.fallback_of) for member, _ in self._originals]
        _set_fallbacks(self._originals)
        try:
            yield
        finally:
            if not self._begun:
                _set_fallbacks(before)

    def kill_all(self, *, but: Sequence[str]) -> None:
        """Kill those that are turned off, except those that are to stand by."""
        self._killed = [name for name in self._going if name not in but]

    def transition(self) -> Transition:
        """Return the plan."""
        model = self._task_set.model
        stays = [one for one in model if one.is_on and one.name not in self._going]
        wanted = {**self._coming, **self._standbys}
        new = [one for one in wanted.values() if one.name not in model]
        order = legality.spawn_order([one.task for one in (*model, *new)])
        spawns = {one.name: one.rtpu for one in new}
        spawns = {name: spawns[name] for name in order if name in spawns}
        items = legality.change_order(
            [one.task for one in self._going.values() if one.is_on],
            [one.task for one in self._coming.values()],
            [one.task for one in stays],
        )
        return Transition(
            stays=[one.name for one in stays],
            spawns=spawns,
            items=items,
            kills=self._killed,
            replaces=constants.taken_over(wanted.values(), self._going.values()),
        )

    def change(self, transition: Transition) -> legality.Change:
        """Return the change that this makes, to be judged."""
        wanted = {**self._coming, **self._standbys}
        items = [(name, "spawn") for name in transition.spawns]
        items += [(name, "on") for name in transition.stays]  # so the end is demanded
        items += [*transition.items, *((name, "kill") for name in transition.kills)]
        new = [wanted[name].task for name in transition.spawns]
        return legality.reconfig(items, new, transition.replaces)

    def pair(self) -> None:
        """Have standbys stand by, and others no longer.

        Raises:
            PbonetError: One could not take over.
        """
        assembly.part(self._task_set, self._parted)
        assembly.pair(self._task_set, list(self._standbys.values()))

    def spawn(
        self,
        transition: Transition,
        stopped: threading.Event,
        gate: ConditionGate | None,
    ) -> None:
        """Create the tasks that do not exist; a failure leaves none of them.

        Those that give constants in the place of others do so from here on.

        Raises:
            ConditionError: A condition does not hold any more.
            PbonetError: One could not be created.
        """
        done = assembly.Done(self._task_set)
        replaces, kills = transition.replaces, transition.kills
        with done.undone_on_error("the change was not begun"):
            for name in replaces.keys() - transition.spawns:
                done.give(name, replaces[name], kills)
            for name in transition.spawns:
                assembly.go_on(stopped)
                member = (self._coming | self._standbys)[name]
                done.spawn(member, replaces.get(name, ()), kills)
            if gate is not None:
                if transition.spawns:
                    gate.must_hold()
                # Before a task that has a standby may fail.
                free = self._standbys.keys() - self._kept
                assembly.pair(self._task_set, [self._standbys[name] for name in free])
                gate.entered()
        self._begun = True
        if transition.spawns:
            self._task_set.rank()


def plan_swap(
    task_set: SubsystemTasks,
    old: str | Sequence[str],
    new: str | Sequence[str],
    rtpu: str | None,
) -> Plan:
    """Return the plan that puts tasks into the place of others.

    Raises:
        UnknownTaskError: There is no such old task.
        StateError: A new task stands in ERROR, or on another RTPU than `rtpu`.
        VerificationError: No task is named.
    """
    olds, news = _once_each(old), _once_each(new)
    for name in olds:
        _recall_lost(task_set, name, news)
    plan = Plan(task_set)
    plan.take_out([task_set.model.find(name) for name in olds], but=news)
    for name in news:
        plan.put_in(_newcomer(task_set, name, rtpu, task_set.model.find(olds[0])))
    return plan


def _recall_lost(task_set: SubsystemTasks, name: str, news: Sequence[str]) -> None:
    """Enter a task that was lost into the model if one of its successors knows it.

    A master that was opened after the loss has not seen it; its fallback on another
    RTPU names it. It may be ON if its RTPU does not answer; if it does, it is not.
    """
    standbys = [task_set.model.get(new) for new in news]
    for one in standbys:
        if (
            name not in task_set.model
            and one is not None
            and (one.fallback_of, bool(one.original_rtpu)) == (name, True)
        ):
            task_set.recall(name, one.original_rtpu)


def plan_job(task_set: SubsystemTasks, job: JobFile) -> Plan:
    """Return the plan that leads to a job.

    Raises:
        PbonetError: RMODs, RTPUs or modules are missing or wrong.
        StateError: A task of the job stands, but is another one.
    """
    plan = Plan(task_set)
    wanted = assembly.plan(task_set, job)
    plan.take_out(
        [one for one in task_set.model if one.state is not State.OFF],
        but=[member.name for member in wanted if not member.fallback_of],
    )
    plan.kill_all(but=[member.name for member in wanted])
    for member in wanted:
        stands = assembly.stands(task_set, member)
        standing = task_set.model.find(member.name) if stands else member
        plan.pair_with(standing, member.fallback_of)
        if member.fallback_of:
            plan.have_ready(standing, member.fallback_of)
        else:
            plan.put_in(standing)
        if stands:
            _must_run_at(task_set.model.find(member.name), member)
    for member, original in assembly.unpaired(task_set, wanted):
        plan.part(member, original)
    return plan


def _set_fallbacks(pairs: Sequence[tuple[Member, str]]) -> None:
    for member, original in pairs:
        member.fallback_of = original


def _newcomer(
    task_set: SubsystemTasks, name: str, rtpu: str | None, old: Member
) -> Member:
    """Return a task of the new job: the existing one, else the one to be spawned.

    Raises:
        StateError: It stands, but in ERROR or on another RTPU.
        PbonetError: Its RMOD, RTPU or module is missing or wrong.
    """
    member = task_set.model.get(name)
    if member is None:
        source = task_set.files.rmod(name)
        member = task_set.plan(source, rtpu or source.record.rtpu or old.rtpu, None)
        task_set.must_be_new(member)
        return member
    place = f"{member.rtpu}/{name}"
    if member.state is State.ERROR:
        raise StateError(
            f"the task {name} cannot be turned on",
            where=place,
            expected="state OFF",
            got="state ERROR",
            remedy=f"'clear {name}' brings it out of ERROR, 'kill {name}' removes it",
        )
    if rtpu not in {None, member.rtpu}:
        raise StateError(
            f"the task {name} is on another RTPU",
            where=place,
            expected=str(rtpu),
            got=member.rtpu,
            remedy=f"leave the RTPU out, or 'kill {name}' first",
        )
    return member


def _must_run_at(standing: Member, wanted: Member) -> None:
    if abs(standing.freq - wanted.freq) > _RATE * wanted.freq:
        raise StateError(
            f"the task {standing.name} has another frequency",
            where=f"{standing.rtpu}/{standing.name}",
            expected=f"{wanted.freq:g} Hz, as in the job",
            got=f"{standing.freq:g} Hz",
            remedy=f"'freq {standing.name} {wanted.freq:g}' first",
        )


def _once_each(given: str | Sequence[str]) -> list[str]:
    """Return task names without repetition.

    Raises:
        VerificationError: There is none.
    """
    names = [given] if isinstance(given, str) else list(given)
    if not names:
        raise VerificationError(
            "no task is named",
            expected="the tasks that leave and those that come",
            remedy="name them, such as swap('old', 'new')",
        )
    return [name.removesuffix(".rmod") for name in dict.fromkeys(names)]
