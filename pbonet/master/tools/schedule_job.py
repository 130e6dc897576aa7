"""A job's schedule in virtual time, with given execution times (section 6.2).

No agent is asked. With `code` the modules run too: a cycle reads its inputs when it
begins, its outputs appear when it ends, and what lies between is the given time. So a
control law meets the delays and missed cycles of its schedule, the same ones each time.
"""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.analysis import legality
from pbonet.analysis.schedule import CoreShare
from pbonet.config import Library, TaskType
from pbonet.errors import ConfigFileError, PbonetError, SeveralError
from pbonet.io import no_devices
from pbonet.master.configuration import Files, here, planned
from pbonet.master.sim import BEGIN_NS, REASON
from pbonet.master.subsystem import Subsystem
from pbonet.pbo import State

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Mapping

    from pbonet.config import JobFile
    from pbonet.master.sim import VirtualRtpus
    from pbonet.svar import Table

    Watch = Callable[[int, str, Table], None]

_LOADS = frozenset({
    legality.Code.OVERLOAD,
    legality.Code.SERVER,
    legality.Code.TIMES,
    legality.Code.BANDWIDTH,
})
"""Problems that prevent a start and that a simulation is there to show."""


def simulate(
    path: str | Path,
    seconds: float,
    folders: Iterable[str | Path] = (),
    *,
    host: str = "",
    times: legality.Times = legality.Times.WORST,
    seed: int = 0,
    assume: float | None = None,
    code: bool = False,
    rates: Mapping[str, float] | None = None,
    watch: Watch | None = None,
) -> tuple[legality.JobOutcome, list[str]]:
    """Run a job in virtual time; return its schedule and what is to be said.

    Args:
        path: The ``.job`` file.
        seconds: How much virtual time passes, above 0.
        folders: Of module libraries.
        host: The machine whose saved profiles are used; this one if empty.
        times: Which execution times cycles take.
        seed: Of random ones.
        assume: Share of its period that a cycle of unknown MAXC takes.
        code: Run the modules too.
        rates: Hz of tasks, in place of those that the job has.
        watch: Called with `code` after each cycle, with the time in nanoseconds since
            the start, the task, and the table.

    Raises:
        ConfigError: A file is missing or wrong.
        VerificationError: The job is illegal in other ways than by its load, or an
            execution time is not known.
        PbonetError: A module does not load, or fails in `init` or `on`.
    """
    folders = list(folders)
    files = Files(path, Library(folders))
    files.job = _at_rates(files.read_job(), rates or {})
    verdict, parts = planned(files, host or here(), core=CoreShare())
    errors = [PbonetError.from_wire(error) for error in parts.errors]
    if len(errors) > 1:
        raise SeveralError("the job cannot be simulated", errors)
    if errors or verdict is None:
        raise errors[0]
    verdict = without_loads(verdict)
    verdict.check()
    told = [*parts.warnings, *map(legality.as_text, verdict.warnings)]
    told += [_no_work(task) for task in verdict.after.running if _is_idle(task)]
    modules = (
        _running(path, folders, told, rates or {}, watch) if code else nullcontext()
    )
    with no_devices(REASON), modules as run:
        outcome = legality.simulate_job(
            verdict.after,
            seconds=seconds,
            times=times,
            seed=seed,
            assume=assume,
            code=run,
        )
    return outcome, told


def _is_idle(task: legality.Task) -> bool:
    return task.rmod.tasktype is TaskType.BACKGROUND and task.worst is None


def _no_work(task: legality.Task) -> str:
    return (
        f"background task {task.name} has nothing to do here: MAXC of its cycles is "
        "not known; declare it, and it uses the time that the others leave"
    )


def without_loads(verdict: legality.Verdict) -> legality.Verdict:
    """Return a verdict that only warns of what a schedule will show."""
    problems = tuple(
        structs.replace(problem, severity=legality.Severity.WARN)
        if problem.code in _LOADS
        else problem
        for problem in verdict.problems
    )
    return structs.replace(verdict, problems=problems)


def _at_rates(job: JobFile, rates: Mapping[str, float]) -> JobFile:
    """Return a job with other frequencies of tasks."""
    tasks = tuple(
        structs.replace(task, freq=rates.get(task.rmod, task.freq))
        for task in job.tasks
    )
    return structs.replace(job, tasks=tasks)


@contextmanager
def _running(
    path: str | Path,
    folders: list[str | Path],
    told: list[str],
    rates: Mapping[str, float],
    watch: Watch | None,
) -> Generator[ScheduledModules]:
    """Have a job be ON in virtual time, and give what runs its modules.

    Nothing of a schedule depends on fallbacks, so they are left out.

    Args:
        path: The ``.job`` file.
        folders: Of module libraries.
        told: Takes what is to be said of the run.
        rates: Hz of tasks, in place of those that the job has.
        watch: See `simulate`.
    """
    subsystem = Subsystem(path, libraries=folders, virtual=True, warned=lambda _: None)
    simulation = subsystem.simulation
    assert simulation is not None  # noqa: S101 - it is virtual
    simulation.world.simulated = list(TaskType)
    job = _at_rates(subsystem.files.read_job(), rates)
    told += [
        f"the fallback {task.fallback} of {task.rmod} is not simulated"
        for task in job.tasks
        if task.fallback is not None
    ]
    tasks = tuple(structs.replace(task, fallback=None) for task in job.tasks)
    subsystem.files.job = structs.replace(job, tasks=tasks)
    try:
        subsystem.open()
        subsystem.task_set.accepted = _LOADS
        subsystem.start()
        try:
            yield ScheduledModules(simulation, watch)
        finally:
            subsystem.stop()
    finally:
        subsystem.detach()
        simulation.close()
        told += simulation.events


class ScheduledModules:
    """The modules of a job, run when the schedule says so; a `legality.ModuleCode`.

    A server's cycle runs for each event that the schedule has, and that of a background
    task for each piece of work; its `sync`, as that of a synchronous task, waits for
    nothing here and is not called.
    """

    def __init__(self, rtpus: VirtualRtpus, watch: Watch | None = None) -> None:
        self._rtpus, self._watch = rtpus, watch
        (self._table,) = rtpus.world.tables.values()
        self._hosts = {
            host.spec.task: host
            for rtpu in rtpus.rtpus.values()
            for host in rtpu.hosts.values()
        }

    def begin(self, task: str, now_ns: int, release_ns: int) -> bool:
        """Run a cycle on the inputs of this instant; its outputs are held."""
        del now_ns  # a cycle gets its release time, as on an RTPU
        host = self._hosts[task]
        if host.executor.state is not State.ON:
            return False
        self._rtpus.set_time(BEGIN_NS + release_ns)
        host.local.held = True
        host.core.grant(
            host.slot.index, self._rtpus.now_ns, periodic=host.spec.freq > 0
        )
        host.run()
        self._rtpus.world.loop.run()
        on = host.executor.state is State.ON
        if not on:
            host.local.publish()
        return on

    def end(self, task: str, now_ns: int) -> None:
        """Publish the outputs of the cycle that ends."""
        self._rtpus.set_time(BEGIN_NS + now_ns)
        self._hosts[task].local.publish()
        if self._watch is not None:
            self._watch(now_ns, task, self._table)


def write_svg(outcome: legality.JobOutcome, path: Path, show_ns: int = 0) -> list[Path]:
    """Write a picture of each RTPU's schedule; of several, one file each.

    Args:
        outcome: The schedules.
        path: The file; of several RTPUs each one's name is put before the suffix.
        show_ns: How much of the schedule is shown; 0 for four times the longest
            period.

    Returns:
        The files.

    Raises:
        ConfigFileError: A file cannot be written.
    """
    pictures = outcome.svg(show_ns=show_ns)
    written: list[Path] = []
    for rtpu, text in pictures.items():
        name = path.name if len(pictures) == 1 else f"{path.stem}-{rtpu}{path.suffix}"
        file = path.with_name(name)
        try:
            file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigFileError(
                "the plot cannot be written",
                where=str(file),
                got=error.strerror or str(error),
                remedy="name a folder that is there and writable",
            ) from None
        written.append(file)
    return written
