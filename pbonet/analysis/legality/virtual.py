"""A configuration in virtual time: every RTPU's schedule, for given execution times.

The tasks that are ON get the criticalities and user priorities that the runtime would
give them, and the execution times that are known of them. Module code runs only for a
caller that brings it (`ModuleCode`).
"""

from __future__ import annotations

import random
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeAlias

from msgspec import Struct

from pbonet.analysis.schedule import (
    Core,
    Outcome,
    PeriodicTask,
    ServerKind,
    ServerTask,
    chart,
    criticality,
)
from pbonet.config import Scheduler, TaskType
from pbonet.errors import VerificationError

from .demands import SERVER_TYPES, effective, is_periodic, least, ns
from .order import user_priorities
from .timing import criticalities

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from pbonet.analysis.schedule import Assigned, CoreShare
    from pbonet.config import RtpuEntry

    from .records import Configuration, Task


_Hooks: TypeAlias = """tuple[
    Callable[[int, int], None] | None, Callable[[int], None] | None
]"""


class Times(StrEnum):
    """Which execution time a cycle takes."""

    WORST = "worst"
    """MAXC, always."""
    RANDOM = "random"
    """Drawn from the measured profile; without one, evenly from MINC to MAXC."""


class ModuleCode(Protocol):
    """Runs the tasks' own code while their cycles pass in virtual time."""

    def begin(self, task: str, now_ns: int, release_ns: int) -> bool:
        """Run a cycle on the inputs of this instant; False when the task is ON no more.

        Its outputs are not to be seen before `end`.
        """
        ...

    def end(self, task: str, now_ns: int) -> None:
        """Publish the outputs of the cycle that ends."""


class JobOutcome(Struct, frozen=True, kw_only=True):
    """The schedules of all RTPUs."""

    seconds: float
    times: Times
    seed: int
    assumed: tuple[str, ...]
    """Tasks without MAXC, which took the assumed share of their period."""
    rtpus: dict[str, Outcome]
    stopped: tuple[str, ...] = ()
    """Tasks whose code ended the task, so that it ran no further."""

    @property
    def missing(self) -> set[str]:
        """The names of the tasks that missed a deadline."""
        return {name for outcome in self.rtpus.values() for name in outcome.missing}

    def as_data(self, *, segments: bool = True) -> dict[str, object]:
        """Return everything as plain values, ready for JSON."""
        return {
            "seconds": self.seconds,
            "times": self.times.value,
            "seed": self.seed,
            "assumed": list(self.assumed),
            "missing": sorted(self.missing),
            "rtpus": {
                name: outcome.as_data(segments=segments)
                for name, outcome in self.rtpus.items()
            },
        }

    def as_text(
        self, *, columns: int = 72, show_ns: int = 0, marks: chart.Marks | None = None
    ) -> str:
        """Return a chart of the beginning and a table for each RTPU.

        Args:
            columns: The widest chart.
            show_ns: How much of the schedule the charts show; 0 for four times the
                longest period.
            marks: The characters of the charts.
        """
        parts = [
            f"RTPU {name}: {outcome.utilization:.1%} used in {self.seconds:g} s; "
            + _verdict(outcome)
            + "\n"
            + chart.as_text(
                outcome,
                end_ns=outcome.start_ns + (show_ns or _stretch(outcome)),
                columns=columns,
                marks=marks,
            )
            + "\n"
            + outcome.as_text()
            for name, outcome in self.rtpus.items()
            if outcome.tasks
        ]
        if self.assumed:
            parts.append(f"execution times assumed: {' '.join(self.assumed)}")
        return "\n\n".join(parts)

    def svg(self, *, show_ns: int = 0) -> dict[str, str]:
        """Return a picture of the beginning of each RTPU's schedule, by name."""
        return {
            name: chart.as_svg(
                outcome,
                title=f"RTPU {name}: {_verdict(outcome)}",
                end_ns=outcome.start_ns + (show_ns or _stretch(outcome)),
            )
            for name, outcome in self.rtpus.items()
            if outcome.tasks
        }


def _verdict(outcome: Outcome) -> str:
    late = " ".join(name for name in outcome.tasks if name in outcome.missing)
    return f"missed deadlines: {late}" if late else "no deadline was missed"


def _stretch(outcome: Outcome) -> int:
    longest = max(account.period_ns for account in outcome.tasks.values())
    span = outcome.end_ns - outcome.start_ns
    return min(span, 4 * longest) if longest else span


def simulate_job(
    configuration: Configuration,
    *,
    seconds: float,
    times: Times = Times.WORST,
    seed: int = 0,
    assume: float | None = None,
    events: Mapping[str, Iterable[tuple[int, int]]] | None = None,
    keep: bool = True,
    code: ModuleCode | None = None,
) -> JobOutcome:
    """Simulate the tasks of a configuration that are ON.

    For a job that does not run yet, ``judge(..., job(tasks)).after`` is the
    configuration that it ends in.

    Args:
        configuration: The tasks, and the RTPUs that they are on.
        seconds: Virtual time, above 0.
        times: Which execution times are taken.
        seed: Of the random ones; the same one gives the same schedule.
        assume: Share of its period that a cycle of unknown MAXC takes; None refuses
            such tasks.
        events: Instant and CPU nanoseconds of each event, by server or background
            task. A server that is not named is asked for its whole capacity at the
            begin of every period; a background task with a known MAXC always has
            another piece of work that takes as long, and one without has none.
        keep: Keep segments, for charts.
        code: Runs the tasks' own code; without it cycles only take their time.

    Raises:
        VerificationError: MAXC of a task is not known, or `seconds` is not above 0.
    """
    if not seconds > 0:
        raise VerificationError(
            "a simulation needs time",
            expected="seconds above 0",
            got=f"{seconds:g}",
            remedy="give a longer time",
        )
    tasks = configuration.running
    unknown = tuple(t.name for t in tasks if is_periodic(t) and t.worst is None)
    if unknown and assume is None:
        raise _no_times(unknown)
    build = _Builder(
        times=times,
        seed=seed,
        assume=assume or 0.0,
        events=dict(events or {}),
        priorities=user_priorities(tasks),
        until_ns=ns(seconds),
        keep=keep,
        code=code,
    )
    cores = {
        rtpu.name: build.core(
            [task for task in tasks if task.rtpu == rtpu.name],
            rtpu,
            shares=configuration.share_of(rtpu.name),
        )
        for rtpu in configuration.rtpus
    }
    if code is not None:
        build.in_step(cores)
    for core in cores.values():
        core.run_until(build.until_ns)
    return JobOutcome(
        seconds=seconds,
        times=times,
        seed=seed,
        assumed=unknown,
        rtpus={name: core.outcome() for name, core in cores.items()},
        stopped=tuple(build.stopped),
    )


def _no_times(unknown: Sequence[str]) -> VerificationError:
    return VerificationError(
        f"the execution time of {' and '.join(unknown)} is not known",
        where=unknown[0],
        expected="MAXC in the .rmod, or a measured profile",
        got="neither",
        remedy="declare MAXC, measure it with 'pbonet run --profile', or give "
        "the share of a period to assume: --assume 0.1",
    )


class _Builder(Struct, kw_only=True):
    """Makes the simulator's tasks from those of a configuration."""

    times: Times
    seed: int
    assume: float
    events: dict[str, Iterable[tuple[int, int]]]
    priorities: dict[str, int]
    until_ns: int
    keep: bool
    code: ModuleCode | None
    stopped: list[str] = []

    def core(
        self, tasks: Sequence[Task], rtpu: RtpuEntry, *, shares: CoreShare
    ) -> Core:
        """Return one RTPU before its first instant."""
        assigned = criticalities(tasks, rtpu, core=shares)
        made: list[Core] = []
        rates = rtpu.scheduler is Scheduler.RM
        made.append(
            Core(
                [
                    self._task(t, assigned[t.name], made, rates=rates)
                    for t in tasks
                    if is_periodic(t)
                ],
                [
                    self._server(t, assigned[t.name], made, rates=rates)
                    for t in tasks
                    if not is_periodic(t) and self._serves(t)
                ],
                keep=self.keep,
            )
        )
        return made[0]

    def in_step(self, cores: Mapping[str, Core]) -> None:
        """Run all cores in the order in which their tasks read and write."""
        while True:
            core = min(cores.values(), key=Core.next_ns)
            if core.next_ns() > self.until_ns:
                return
            core.step()

    def _serves(self, task: Task) -> bool:
        """Return whether a task can be simulated that the clock does not release."""
        if task.rmod.tasktype in SERVER_TYPES:
            return task.hz is not None and task.rmod.capacity is not None
        return task.name in self.events or task.worst is not None

    def _task(
        self, task: Task, assigned: Assigned, on: list[Core], *, rates: bool
    ) -> PeriodicTask:
        """Return a task; `on` will hold the core that it runs on."""
        soft = effective(task)
        begun, done = self._hooks(task.name, on)
        return PeriodicTask(
            name=task.name,
            period_ns=ns(1.0 / (task.hz or 1.0)),
            cost=self._cost(task),
            crit=assigned.crit,
            priority=self.priorities.get(task.name, 0),
            least_ns=ns(least(task).seconds or 0.0),
            effective_ns=ns(soft.seconds or 0.0) if soft else 0,
            drop_crit=criticality.dropped(assigned.crit, fixed_rates=rates),
            begun=begun,
            done=done,
        )

    def _hooks(self, name: str, on: list[Core]) -> _Hooks:
        """Return what runs a task's code at the begin and the end of its cycles."""
        code = self.code
        if code is None:
            return None, None

        def begun(now_ns: int, release_ns: int) -> None:
            if not code.begin(name, now_ns, release_ns):
                self.stopped.append(name)
                on[0].stop(name)

        def done(now_ns: int) -> None:
            code.end(name, now_ns)

        return begun, done

    def _cost(self, task: Task) -> int | Callable[[], int]:
        if task.worst is None:
            return ns(self.assume / (task.hz or 1.0))
        return self._known_cost(task, task.worst)

    def _known_cost(self, task: Task, worst: float) -> int | Callable[[], int]:
        if self.times is Times.WORST:
            return ns(worst)
        source = random.Random(f"{self.seed} {task.name}")  # noqa: S311
        profile = task.profile
        if profile is not None:
            return lambda: profile.draw_ns(source)
        low, high = ns(least(task).seconds or 0.0), ns(worst)
        return lambda: source.randint(min(low, high), high)

    def _server(
        self, task: Task, assigned: Assigned, on: list[Core], *, rates: bool
    ) -> ServerTask:
        begun, done = self._hooks(task.name, on)
        kind = SERVER_TYPES.get(task.rmod.tasktype, ServerKind.BACKGROUND)
        if task.rmod.tasktype is TaskType.BACKGROUND:
            period = capacity = 0
        else:
            period = ns(1.0 / (task.hz or 1.0))
            capacity = min(ns(task.rmod.capacity or 0.0), period)
        arrivals, more = self.events.get(task.name), None
        if arrivals is None and not period and task.worst is not None:
            cost, arrivals = self._known_cost(task, task.worst), ()
            more = cost if callable(cost) else partial(max, 1, cost)
        elif arrivals is None:
            arrivals = _all_of_it(period, capacity, self.until_ns)
        return ServerTask(
            name=task.name,
            kind=kind,
            arrivals=arrivals,
            capacity_ns=capacity,
            period_ns=period,
            crit=assigned.crit,
            drop_crit=criticality.dropped(
                assigned.crit, fixed_rates=rates, server=True
            ),
            priority=self.priorities.get(task.name, 0),
            more=more,
            begun=begun,
            done=done,
        )


def _all_of_it(period: int, capacity: int, until_ns: int) -> Iterator[tuple[int, int]]:
    for instant in range(0, until_ns, period):
        yield instant, capacity
