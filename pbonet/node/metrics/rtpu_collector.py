"""Makes metrics of what ``status`` reads, when they are asked for.

Names, units and kinds follow the conventions of Prometheus: base units, ``_total`` for
what only grows, ``_ratio`` for shares. Counters of a task begin again when it is turned
on, as in ``status``; Prometheus takes that for a reset.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from pbonet.errors import NodeError, PbonetError
from pbonet.pbo import State

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from pbonet.xm.net import (
        AgentInfo,
        LinkReport,
        RtpuStatus,
        TaskStatus,
        messages as m,
    )


class Age(Protocol):
    """The age of a variable."""

    @property
    def variable(self) -> str:
        """Its name."""
        ...

    @property
    def seconds(self) -> float | None:
        """Its age; None: it was never written."""
        ...

    @property
    def stale(self) -> bool:
        """Whether it is older than the table allows."""
        ...


class Figures(Protocol):
    """The part of an agent that the metrics are read from; no task is asked."""

    def info(self) -> AgentInfo:
        """Return the agent's identity."""
        ...

    def status(self, subsystem: str) -> RtpuStatus:
        """Return the status of a subsystem's tasks on the RTPU."""
        ...

    def ages(self, subsystem: str) -> Sequence[Age]:
        """Return the ages of a subsystem's variables."""
        ...

    def ways(self, *, measure: bool = True) -> LinkReport:
        """Return the paths to the other agents."""
        ...

    def machine(self) -> m.MachineInfo:
        """Return the disk on which runs are recorded."""
        ...


class _Family(NamedTuple):
    """A metric: its name without the prefix, its help, and its labels."""

    name: str
    help: str
    labels: tuple[str, ...] = ()
    counter: bool = False


_TASK: Final = ("subsystem", "task")
_AGENT: Final = (
    _Family("agent_info", "The agent.", ("host", "version", "domain", "backend")),
    _Family("agent_keys_left_seconds", "Time until its certificate expires."),
    _Family("agent_lost_peers", "Agents that it has seen and no longer sees."),
    _Family("peer_round_trip_seconds", "Last round trip to an agent.", ("peer",)),
    _Family("peer_clock_offset_seconds", "Its monotonic clock is ahead.", ("peer",)),
    _Family("runs_free_bytes", "Free space where runs are recorded."),
    _Family("runs_size_bytes", "Size of that file system."),
)
_RTPU: Final = (
    _Family("rtpu_up", "1 while the RTPU process answers."),
    _Family("rtpu_utilization_ratio", "Share of the core that tasks take."),
    _Family("rtpu_dispatcher_ratio", "Share of the core that the dispatcher takes."),
    _Family("rtpu_stalls_total", "Stalls of the core above 20 ms.", counter=True),
    _Family("rtpu_stalled_seconds_total", "Duration of all stalls.", counter=True),
    _Family(
        "illegal_causes",
        "Causes for which the illegal-configuration flag is up.",
        ("subsystem",),
    ),
    _Family(
        "unlogged_records_total",
        "Records that could not be written to the log.",
        ("subsystem",),
        counter=True,
    ),
    _Family(
        "events_total",
        "Events by code, suppressed ones included.",
        ("subsystem", "task", "code"),
        counter=True,
    ),
    _Family("variable_age_seconds", "Age of a variable.", ("subsystem", "variable")),
    _Family(
        "variable_stale", "1 if it is older than MAXAGE.", ("subsystem", "variable")
    ),
    _Family("link_age_seconds", "Age of a link's newest record.", ("link",)),
    _Family(
        "link_records_total", "Number of its newest record.", ("link",), counter=True
    ),
)


class _TaskFamily(NamedTuple):
    """A metric of a task that is one field of its status."""

    family: _Family
    read: Callable[[TaskStatus], float]


def _of_task(
    name: str, text: str, read: Callable[[TaskStatus], float], *, counter: bool = False
) -> _TaskFamily:
    return _TaskFamily(_Family(f"task_{name}", text, _TASK, counter), read)


_TASKS: Final = (
    _of_task("cycles_total", "Cycles since on.", lambda t: t.cycle, counter=True),
    _of_task("missed_total", "Missed cycles since on.", lambda t: t.miss, counter=True),
    _of_task(
        "failed_total",
        "Cycles with an error.",
        lambda t: t.failed,
        counter=True,
    ),
    _of_task(
        "cpu_seconds_total", "CPU time of its cycles.", lambda t: t.tot_c, counter=True
    ),
    _of_task("warnings_total", "Warnings since on.", lambda t: t.warn, counter=True),
    _of_task(
        "page_faults_total",
        "Minor page faults since on.",
        lambda t: t.faults,
        counter=True,
    ),
    _of_task(
        "lost_records_total",
        "Records that did not fit its ring.",
        lambda t: t.lost,
        counter=True,
    ),
    _of_task(
        "aborted_total",
        "Cycles cut short.",
        lambda t: t.aborted,
        counter=True,
    ),
    _of_task("reference_hertz", "Rate that it should have.", lambda t: t.ref_f),
    _of_task("cpu_longest_seconds", "CPU time of one cycle.", lambda t: t.max_c),
    _of_task("delay_longest_seconds", "Longest start delay.", lambda t: t.jitter_max),
    _of_task("criticality", "Its criticality.", lambda t: t.crit),
)
_STATES: Final = _Family("task_state", "1 for its state.", (*_TASK, "state"))
_FAILURES: Final = _Family(
    "task_timing_failures_total", "Timing failures.", (*_TASK, "kind"), counter=True
)
FAMILIES: Final = (*_AGENT, *_RTPU, _STATES, _FAILURES, *(one.family for one in _TASKS))
PREFIX: Final = "pbonet_"


class RtpuCollector(Collector):
    """Collects the metrics of one RTPU; everything has the label ``rtpu``.

    Args:
        rtpu: Its name.
        figures: Where they are read.
    """

    def __init__(self, rtpu: str, figures: Figures) -> None:
        self._rtpu = rtpu
        self._figures = figures

    def describe(self) -> Iterable[Metric]:
        """Return the metrics without values."""
        return _families().values()

    def collect(self) -> Iterable[Metric]:
        """Return the metrics as they are now.

        What cannot be read now is left out: the RTPU process starts again, or a
        subsystem has just ended.
        """
        made = _families()
        info = self._figures.info()
        self._add_agent(made, info)
        up = False
        for subsystem in info.claims or {"": 0}:
            try:
                status = self._figures.status(subsystem)
            except NodeError:
                continue
            except PbonetError:  # its table has just been closed
                up = True
                continue
            up = True
            self._add_rtpu(made, status)
            if subsystem:
                self._add_subsystem(made, subsystem, status)
        self._add(made, "rtpu_up", float(up))
        return [one for one in made.values() if one.samples]

    def _add(self, made: dict[str, Any], name: str, value: float, *labels: str) -> None:
        made[name].add_metric([self._rtpu, *labels], value)

    def _add_agent(self, made: dict[str, Any], info: AgentInfo) -> None:
        about = (info.host, info.version, info.domain, info.backend)
        self._add(made, "agent_info", 1.0, *about)
        if info.keys_left is not None:
            self._add(made, "agent_keys_left_seconds", info.keys_left)
        self._add(made, "agent_lost_peers", len(info.lost))
        for way in self._figures.ways(measure=False).ways:
            if not way.error:
                self._add(made, "peer_round_trip_seconds", way.trip, way.rtpu)
                self._add(made, "peer_clock_offset_seconds", way.offset, way.rtpu)
        machine = self._figures.machine()
        if machine.disk_free is not None:
            self._add(made, "runs_free_bytes", machine.disk_free)
            self._add(made, "runs_size_bytes", machine.disk_size or 0)

    def _add_rtpu(self, made: dict[str, Any], status: RtpuStatus) -> None:
        """Add what is the same for all subsystems of the RTPU, once."""
        if made["rtpu_stalls_total"].samples:
            return
        self._add(made, "rtpu_utilization_ratio", status.util)
        self._add(made, "rtpu_dispatcher_ratio", status.dispatcher)
        self._add(made, "rtpu_stalls_total", status.stalls)
        self._add(made, "rtpu_stalled_seconds_total", status.stalled)
        for link in status.tbufs:
            self._add(made, "link_records_total", link.number, link.name)
            if link.age is not None:
                self._add(made, "link_age_seconds", link.age, link.name)

    def _add_subsystem(
        self, made: dict[str, Any], subsystem: str, status: RtpuStatus
    ) -> None:
        self._add(made, "illegal_causes", len(status.illegal), subsystem)
        self._add(made, "unlogged_records_total", status.unlogged, subsystem)
        for task, counts in status.events.items():
            for code, count in counts.items():
                self._add(made, "events_total", count, subsystem, task, code)
        for one in status.tasks:
            self._add_task(made, subsystem, one)
        try:
            ages = self._figures.ages(subsystem)
        except PbonetError:  # its table has just been closed
            return
        for age in ages:
            labels = subsystem, age.variable
            if age.seconds is not None:
                self._add(made, "variable_age_seconds", age.seconds, *labels)
            self._add(made, "variable_stale", float(age.stale), *labels)

    def _add_task(self, made: dict[str, Any], subsystem: str, task: TaskStatus) -> None:
        labels = subsystem, task.task
        for one in _TASKS:
            self._add(made, one.family.name, one.read(task), *labels)
        for state in State:
            here = float(task.state == state)
            self._add(made, "task_state", here, *labels, state.value)
        for kind, count in task.failures.items():
            name = "task_timing_failures_total"
            self._add(made, name, count, *labels, kind)


def _families() -> dict[str, Any]:
    """Return every metric, without values."""
    made: dict[str, Any] = {}
    for one in FAMILIES:
        kind = CounterMetricFamily if one.counter else GaugeMetricFamily
        labels = ["rtpu", *one.labels]
        made[one.name] = kind(PREFIX + one.name, one.help, labels=labels)
    return made
