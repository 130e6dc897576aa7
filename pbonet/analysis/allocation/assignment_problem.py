"""The problem of an assignment: tasks with the RTPUs that each may run on.

A task is given once for each RTPU that it may run on, because its execution time may
differ from machine to machine. Times that were measured count as if they were declared:
an assignment that ignored them would say nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.analysis.legality import Configuration, Task, effective, loads
from pbonet.analysis.schedule import ASSUMED, CoreShare
from pbonet.config import RtpuEntry, SvarFile, TaskType

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

LATENCY = 1e-3
"""Seconds that a value needs from one machine to another, unless told otherwise."""
EXACT = 1e-9
"""Relative error of sums of shares."""


class Item(Struct, frozen=True, kw_only=True):
    """A task to be assigned."""

    name: str
    present: str
    """The RTPU on which the job has it."""
    tasks: Mapping[str, Task]
    """The task by the RTPU that it may run on; one: it is pinned."""
    pin: str = ""
    """Why it may run there only; empty: it may run anywhere."""
    fallback_of: str = ""
    apart: bool = False
    """A standby that takes over by itself (``TAKEOVER``): never on the machine of its
    original."""

    @property
    def task(self) -> Task:
        """The task as on the first RTPU that it may run on."""
        return next(iter(self.tasks.values()))

    @property
    def period(self) -> float:
        """Seconds between two cycles; 0: it has no rate."""
        hz = self.task.hz
        return 1.0 / hz if hz else 0.0

    def share(self, rtpu: str) -> float:
        """Return the share of the core that it is given on an RTPU."""
        return share(self.tasks[rtpu])


class Problem(Struct, frozen=True, kw_only=True, dict=True):
    """The tasks, the RTPUs and what an assignment costs."""

    items: tuple[Item, ...]
    rtpus: tuple[RtpuEntry, ...]
    machines: Mapping[str, str]
    """The machine of each RTPU."""
    keeper: str
    """The RTPU that keeps the table."""
    sizes: Mapping[str, int] = {}
    """Bytes of each variable."""
    rates: Mapping[str, float] = {}
    """How often a second a variable is carried at most (``RATE``), where limited."""
    cores: Mapping[str, CoreShare] = {}
    """The share of each RTPU's core for tasks; `ASSUMED` of those not in it."""
    weight: float = 0.5
    """Share of the cost that traffic has; the rest is age."""
    latency: float = LATENCY

    @cached_property
    def by_name(self) -> dict[str, Item]:
        """The items by their names."""
        return {item.name: item for item in self.items}

    @cached_property
    def running(self) -> tuple[Item, ...]:
        """Tasks that are ON: all but the standbys."""
        return tuple(item for item in self.items if not item.fallback_of)

    @cached_property
    def standbys(self) -> tuple[Item, ...]:
        """Tasks that stand by."""
        return tuple(item for item in self.items if item.fallback_of)

    def core(self, rtpu: str) -> CoreShare:
        """Return what tasks may use of the core of an RTPU."""
        return self.cores.get(rtpu, ASSUMED)

    def load(self, item: Item, rtpu: str) -> float:
        """Return the share of a core that a task takes, with dispatching it."""
        return item.share(rtpu) + self.core(rtpu).dispatch * (item.task.hz or 0.0)

    @property
    def limits(self) -> str:
        """The share of the cores that may be used, as a phrase."""
        cores = {one.name: self.core(one.name) for one in self.rtpus}
        found = {(one.share, one.dispatch) for one in cores.values()}
        named = {"each": next(iter(cores.values()))} if len(found) == 1 else cores
        return "at most " + ", ".join(
            f"{core.share:.1%} of {name if len(found) > 1 else 'each core'}"
            + f", dispatching included ({core.dispatch * 1e6:g} us a release)"
            * bool(core.dispatch)
            for name, core in named.items()
        )

    def entry(self, rtpu: str) -> RtpuEntry:
        """Return the entry of an RTPU."""
        return next(one for one in self.rtpus if one.name == rtpu)


Places = Mapping[str, str]
"""The RTPU of each task."""


def declared(task: Task) -> Task:
    """Return a task whose measured times are declared ones, as `adopt` makes them."""
    found = effective(task)
    soft = task.rmod.effc if found is None else found.seconds
    rmod = structs.replace(task.rmod, maxc=task.worst, effc=soft)
    return structs.replace(task, rmod=rmod, minc=None, maxc=None, profile=None)


def share(task: Task) -> float:
    """Return the share of a core that a task is given: equation 8, with E if soft."""
    if task.rmod.capacity is not None:
        return task.rmod.capacity * (task.hz or 0.0)
    if task.rmod.tasktype is TaskType.BACKGROUND:
        return 0.0
    found = effective(task)
    seconds = task.worst if found is None else found.seconds
    return (seconds or 0.0) * (task.hz or 0.0)


_NO_TABLE = SvarFile(file="", defines={}, variables=())


def keeps_deadlines(tasks: Sequence[Task], entry: RtpuEntry, core: CoreShare) -> bool:
    """Return whether an RTPU keeps every deadline of these tasks, if all are ON.

    It is the test of `pbonet check` (section 6.2), which also warns of tasks that may
    miss: here none may, except the late cycles of soft ones.

    Args:
        tasks: The tasks.
        entry: The RTPU.
        core: What they may use of its core.
    """
    placed = tuple(structs.replace(task, rtpu=entry.name) for task in tasks)
    now = Configuration(
        svar=_NO_TABLE,
        tasks=placed,
        on=frozenset(task.name for task in placed),
        rtpus=(entry,),
        core=core,
    )
    (load,) = loads(now)
    hard = {task.name for task in placed if not task.rmod.softness}
    asked = hard & {*load.critical_set, *load.outside}
    left = core.left(task.hz or 0.0 for task in placed)
    within = load.utilization <= left * (1 + EXACT)
    return within and asked <= {*load.guaranteed}


def sets_on(problem: Problem, places: Places, rtpu: str) -> list[list[str]]:
    """Return the sets of tasks that may be ON together on an RTPU.

    They are those of the job; those after one original has been replaced by its standby
    there; and those after all have been.
    """
    on = [one.name for one in problem.running if places[one.name] == rtpu]
    here = [one for one in problem.standbys if places[one.name] == rtpu]
    found = [on]
    found += [[n for n in on if n != one.fallback_of] + [one.name] for one in here]
    if len(problem.standbys) > 1:
        gone = {one.fallback_of for one in problem.standbys}
        found.append([n for n in on if n not in gone] + [one.name for one in here])
    return found


def faults(problem: Problem, places: Places) -> Iterable[tuple[str, list[str]]]:
    """Yield the RTPUs, each with tasks that would miss deadlines there together."""
    for entry in problem.rtpus:
        for names in sets_on(problem, places, entry.name):
            tasks = [problem.by_name[name].tasks[entry.name] for name in names]
            if tasks and not keeps_deadlines(tasks, entry, problem.core(entry.name)):
                yield entry.name, names
                break


def allowed(problem: Problem, places: Places) -> bool:
    """Return whether an assignment respects all: pins, standbys, and deadlines."""
    if any(places[item.name] not in item.tasks for item in problem.items):
        return False
    if not all(_stands_apart(problem, one, places) for one in problem.standbys):
        return False
    return not [*faults(problem, places)]


def _stands_apart(problem: Problem, standby: Item, places: Places) -> bool:
    here, there = places[standby.name], places[standby.fallback_of]
    if not standby.apart:
        return not standby.pin.startswith(FOLLOWS) or here == there
    home = problem.machines[there]
    return problem.machines[here] != home and home != problem.machines[problem.keeper]


FOLLOWS = "stands by on the RTPU of "
"""Begins the reason of a standby that no file gives an RTPU of its own."""
