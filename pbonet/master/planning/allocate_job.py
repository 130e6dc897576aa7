"""``pbonet allocate``: assigns the tasks of a job to RTPUs, and says what it gains."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.analysis import allocation, legality
from pbonet.config import Library
from pbonet.errors import ConfigError, PbonetError
from pbonet.master.configuration import Files, here, judged

from . import known_rtpus
from .allocation_problem import problem_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from pbonet.analysis.allocation import Assignment, Problem
    from pbonet.master.configuration import Place

    from .known_rtpus import KnownRtpus


class RtpuLoad(Struct, frozen=True, kw_only=True):
    """The load of one RTPU, as it is and as it would be."""

    rtpu: str
    machine: str
    before: float
    """Utilization by the tasks that are ON (equation 8)."""
    after: float
    tasks: list[str]
    """The tasks that it would run, standbys too."""


class ChainAge(Struct, frozen=True, kw_only=True):
    """The age at worst of the oldest data at one end of the data flow; seconds."""

    before: float
    after: float
    tasks: list[str]
    """The tasks that the data would pass."""


class Move(Struct, frozen=True, kw_only=True, rename={"source": "from", "to": "to"}):
    """A task that would get another RTPU."""

    task: str
    source: str
    to: str


class Allocation(Struct, frozen=True, kw_only=True):
    """An assignment of a job's tasks, beside the present one."""

    job: str
    rtpus: list[RtpuLoad]
    traffic_before: float
    """Bytes a second that tasks read from other machines."""
    traffic_after: float
    chains: list[ChainAge]
    moves: list[Move]
    pins: dict[str, str]
    """Why tasks may not run everywhere."""
    cost_before: float
    cost_after: float
    weight: float
    """Share of the cost that traffic has; the rest is age."""
    gap: float
    """Share of the cost by which a better assignment may be cheaper; 0: proven best."""
    keeps: bool
    """The present assignment keeps all deadlines and pins."""
    refused: int
    """Sets of tasks that the schedulability test refused on the way."""
    seconds: float
    machines_known: bool

    @property
    def places(self) -> dict[str, str]:
        """The new RTPU of each task that moves."""
        return {move.task: move.to for move in self.moves}


def allocate(
    path: str | Path,
    place: Place,
    *,
    running: bool = False,
    machines: Iterable[str] = (),
    fixed: Collection[str] = (),
    host: str = "",
    assume: float | None = None,
    limit: float | None = None,
    weight: float = 0.5,
    latency: float = allocation.LATENCY,
    seconds: float = allocation.SECONDS,
) -> tuple[Allocation, list[str]]:
    """Assign the tasks of a job to RTPUs; return that and warnings.

    Args:
        path: The ``.job`` file.
        place: Has the folders with modules, and where agents are found.
        running: Ask the agents for their machines and devices.
        machines: Texts ``RTPU=MACHINE``, where no agent is asked.
        fixed: Tasks that stay where they are, beside those that the job marks FIXED.
        host: The machine whose saved profiles count; this one if empty.
        assume: Share of its period that a cycle takes whose MAXC is not known.
        limit: Share of a core that tasks may use; None: what the cores grant.
        weight: Share of the cost that traffic has; the rest is age.
        latency: Seconds that a value needs to another machine.
        seconds: The most that the search may take.

    Raises:
        ConfigError: A file is missing or wrong, or it is no job.
        VerificationError: No assignment is possible, or a time is not known.
        NodeError: An agent was to be asked, and is not there.
        PbonetError: `scipy` is not installed.
    """
    must_have_solver("allocate")
    files = Files(path, Library(place.libraries))
    if files.job is None:
        raise ConfigError(
            "a subsystem's file names no tasks to allocate",
            where=str(path),
            expected="a .job file",
            remedy="name one of its jobs: " + (", ".join(files.jobs()) or "none yet"),
        )
    known = (
        known_rtpus.ask_agents(files.sbs, place)
        if running
        else known_rtpus.as_stated(files.sbs, machines)
    )
    problem, warnings = problem_of(
        files,
        known,
        host or here(),
        fixed=fixed,
        assume=assume,
        limit=limit,
        weight=weight,
        latency=latency,
    )
    found = allocation.assign(problem, seconds)
    _must_be_legal(files, problem, found, known)
    told = bool([*machines]) or running
    result = _described(problem, found, files.job.file, known, told=told)
    return result, [*warnings, *_shared(result.rtpus, known, problem)]


def _shared(
    rtpus: Sequence[RtpuLoad], known: KnownRtpus, problem: Problem
) -> Iterator[str]:
    """Yield a warning of each core that several RTPUs use, with too much together."""
    found: dict[tuple[str, int], list[RtpuLoad]] = {}
    for one in rtpus:
        if one.after and one.rtpu in known.cores:
            place = known.machines[one.rtpu], known.cores[one.rtpu]
            found.setdefault(place, []).append(one)
    for (_, core), sharers in found.items():
        total = sum(one.after for one in sharers)
        if len(sharers) > 1 and total > problem.core(sharers[0].rtpu).share:
            yield (
                f"{', '.join(one.rtpu for one in sharers)} share core {core} of "
                f"{sharers[0].machine}, but each counts as a core of its own; together "
                f"they would use {total:.1%} of it, so that no deadline is guaranteed: "
                "give each a core (pbonet agent --core), or a lower --limit"
            )


def must_have_solver(verb: str) -> None:
    """Check that the solver is installed.

    Args:
        verb: The verb that needs it.

    Raises:
        PbonetError: It is not.
    """
    try:
        import_module("scipy.optimize")
    except ImportError as error:
        raise PbonetError(
            f"{verb} needs a package that does not import",
            got=str(error),
            remedy="pip install 'pbonet[plan]'",
        ) from None


def _must_be_legal(
    files: Files, problem: Problem, found: Assignment, known: KnownRtpus
) -> None:
    """Have the whole job judged as it would be; it must be as legal as a start asks.

    Raises:
        VerificationError: It is not.
    """
    tasks = [
        structs.replace(item.tasks[rtpu], rtpu=rtpu)
        for item in problem.items
        for rtpu in [found.places[item.name]]
    ]
    verdict = judged(files, tasks, known.machines)
    if verdict is not None and verdict.refused:
        raise legality.as_error(verdict.refused)


def _described(
    problem: Problem, found: Assignment, job: str, known: KnownRtpus, *, told: bool
) -> Allocation:
    machines = known_rtpus.readable(known.machines, known.hosts)
    return Allocation(
        job=job,
        rtpus=[
            RtpuLoad(
                rtpu=entry.name,
                machine=machines[entry.name],
                before=_load(problem, found.present, entry.name),
                after=_load(problem, found.places, entry.name),
                tasks=[n for n, rtpu in found.places.items() if rtpu == entry.name],
            )
            for entry in problem.rtpus
        ],
        traffic_before=found.before.traffic,
        traffic_after=found.cost.traffic,
        chains=[
            ChainAge(before=old.seconds, after=new.seconds, tasks=list(new.tasks))
            for old, new in zip(found.before.chains, found.cost.chains, strict=True)
        ],
        moves=[
            Move(task=name, source=found.present[name], to=found.places[name])
            for name in found.moved
        ],
        pins={item.name: item.pin for item in problem.items if item.pin},
        cost_before=found.before.total,
        cost_after=found.cost.total,
        weight=problem.weight,
        gap=found.gap,
        keeps=found.present_keeps,
        refused=found.refused,
        seconds=found.seconds,
        machines_known=told,
    )


def _load(problem: Problem, places: dict[str, str], rtpu: str) -> float:
    """Return the utilization of an RTPU by the tasks that are ON."""
    return sum(
        allocation.share(item.tasks.get(rtpu, item.task))
        for item in problem.running
        if places[item.name] == rtpu
    )
