"""Facts about a subsystem at one time, and read without asking again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.legality import RtpuReport
from pbonet.errors import WireError
from pbonet.master.configuration import Graph, GraphFault, GraphTask
from pbonet.master.subsystem import Missing
from pbonet.xm.net import (
    AgentInfo,
    CoreTrace,
    Event,
    RtpuStatus,
    TaskStatus,
    VarValue,
)

if TYPE_CHECKING:
    from collections.abc import Iterable


class Gap(Struct, frozen=True, kw_only=True):
    """Releases of a task without a cycle, as a log has them."""

    cycle: int
    """The cycle after them."""
    missed: int
    """How many."""
    at: float
    """When, in seconds since 1970."""
    longest: float
    """CPU seconds of the cycle before them."""
    window: float = 0.0
    """Seconds in which the task was ready for cycles that it missed; 0: not known."""
    own: float = 0.0
    """CPU seconds that it had in that time."""
    others: tuple[tuple[str, float], ...] = ()
    """Other tasks of its RTPU, with the CPU seconds that they had in that time."""

    @property
    def away(self) -> float:
        """Seconds of that time in which no task of the RTPU had the core."""
        used = self.own + sum(seconds for _, seconds in self.others)
        return max(self.window - used, 0.0)


class Facts(Struct, kw_only=True):
    """Everything from which `explain` draws its conclusions."""

    subsystem: str
    graph: Graph
    """The tasks that exist, with the faults of their configuration."""
    planned: Graph | None = None
    """The tasks of the job."""
    rtpus: dict[str, RtpuStatus] = {}
    """The status of each RTPU that answers."""
    silent: dict[str, WireError] = {}
    """The error of each RTPU that does not."""
    agents: dict[str, AgentInfo] = {}
    later: dict[str, int] = {}
    """Cycles of each task at a second reading; `watched` seconds after the status."""
    watched: float = 0.0
    on_since: dict[str, float] = {}
    """When each task was turned on, seconds since 1970, where that is known."""
    values: dict[str, VarValue] = {}
    closed: str = ""
    """Why the table is not open on the RTPU that keeps it; empty: it is."""
    keeper: str = ""
    limits: dict[str, float] = {}
    """The largest age of each variable that the table or a reader allows, seconds."""
    inherited: dict[str, list[str]] = {}
    """For each task the inputs whose age it passes on to what it writes."""
    events: list[Event] = []
    """The oldest first."""
    missing: list[Missing] = []
    reports: list[RtpuReport] = []
    shared: list[str] = []
    """RTPUs that the subsystem lets others use too."""
    masters: list[str] = []
    """Masters of the subsystem that live."""
    start: list[GraphFault] = []
    """Why the job would be refused now."""
    tables: list[str] = []
    """Sentences about agents that have no version in common."""
    held: list[str] = []
    """Sentences about machines of which nothing is used."""
    withdrawn: dict[str, tuple[Event, Event]] = {}
    """Causes of the flag that a run withdrew: its first and its last event of each."""
    gaps: dict[str, list[Gap]] = {}
    recorded: dict[str, list[range]] = {}
    """The cycles of each task that a log has; a task spawned again has its own."""
    trace: CoreTrace | None = None
    """The threads that had the core in a miss; None: they were not followed."""
    from_log: bool = False
    unknown: list[str] = []
    """Parts that could not be read."""

    def task(self, name: str) -> TaskStatus | None:
        """Return the status of a task; None: it is on no RTPU that answers."""
        for rtpu in self.rtpus.values():
            for one in rtpu.tasks:
                if one.task == name:
                    return one
        return None

    def has_cycle(self, task: str, cycle: int) -> bool:
        """Return whether the log has a cycle of that number."""
        return any(cycle in numbers for numbers in self.recorded.get(task, ()))

    def drawn(self, name: str) -> GraphTask | None:
        """Return a task's ports and files, as it exists or as the job plans it."""
        for graph in filter(None, (self.graph, self.planned)):
            for one in graph.tasks:
                if one.name == name:
                    return one
        return None

    def tasks(self) -> list[str]:
        """Return the names of the tasks that exist or are planned."""
        names = [task.task for rtpu in self.rtpus.values() for task in rtpu.tasks]
        for graph in filter(None, (self.graph, self.planned)):
            names += [one.name for one in graph.tasks]
        names += [one.task for one in self.missing]
        return list(dict.fromkeys(names))

    def variables(self) -> list[str]:
        """Return the names of the variables."""
        graphs = filter(None, (self.graph, self.planned))
        names = [one.name for graph in graphs for one in graph.variables]
        return list(dict.fromkeys([*names, *self.values]))

    def home(self, task: str) -> str:
        """Return the RTPU of a task, where it is or where the files put it."""
        status = self.task(task)
        if status is not None:
            return status.rtpu
        missing = next((one for one in self.missing if one.task == task), None)
        if missing is not None:
            return missing.rtpu
        drawn = self.drawn(task)
        return drawn.rtpu if drawn is not None else ""

    def writers(self, variable: str) -> list[str]:
        """Return the tasks, existing or planned, that have a variable as output."""
        graphs = filter(None, (self.graph, self.planned))
        found = [
            writer
            for graph in graphs
            for one in graph.variables
            if one.name == variable
            for writer in one.writers
        ]
        return list(dict.fromkeys(found))

    def inputs(self, task: str) -> list[str]:
        """Return the variables that a task reads in each cycle."""
        drawn = self.drawn(task)
        return [p.variable for p in drawn.ins if not p.constant] if drawn else []

    def news(
        self, codes: Iterable[str], *, task: str = "", rtpu: str = "", last: int = 1
    ) -> list[Event]:
        """Return the newest events of some codes, the newest first.

        Args:
            codes: Any of these.
            task: Of this task; empty: of any or none.
            rtpu: Of this RTPU; empty: of any.
            last: At most so many.
        """
        wanted = frozenset(codes)
        found = [
            event
            for event in reversed(self.events)
            if event.code in wanted
            and task in {"", event.task}
            and rtpu in {"", event.rtpu}
        ]
        return found[:last]

    def since_on(self, codes: Iterable[str], status: TaskStatus) -> list[Event]:
        """Return the newest event of some codes of a task since it was turned on."""
        newest = self.news(codes, task=status.task)
        return [one for one in newest if one.time >= status.on_ns or self.from_log]

    def on_rtpu(self, rtpu: str) -> list[TaskStatus]:
        """Return the tasks of an RTPU."""
        status = self.rtpus.get(rtpu)
        return status.tasks if status is not None else []

    def faults_of(self, *, variable: str = "", task: str = "") -> list[GraphFault]:
        """Return faults of the present configuration about a variable or a task."""
        return [
            one
            for one in self.graph.faults
            if (variable and variable in one.variables) or (task and task in one.tasks)
        ]

    def is_old(self, variable: str) -> bool:
        """Return whether a variable is older than the table or a reader allows."""
        value = self.values[variable]
        limit = self.limits.get(variable)
        if value.stale:
            return True
        return limit is not None and (value.age is None or value.age > limit)
