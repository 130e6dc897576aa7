"""``pbonet tune``: chooses rates of tasks by the error that a job has with them.

The job runs in virtual time over a grid of rates. The error is fitted over the periods,
and the rates with the least fitted error within the load are tried, too. What is
proposed is the best that was run, so that it does not rest on the fit.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.analysis import legality
from pbonet.analysis.allocation import fitted
from pbonet.config import Condition, Library, Place as At, TaskType, cost_of
from pbonet.errors import ConfigError, UnknownTaskError, VerificationError, did_you_mean
from pbonet.master.configuration import Files, here

from . import known_rtpus
from .allocate_job import must_have_solver
from .allocation_problem import problem_of
from .parallel_runs import parallel_runs
from .possible_rates import RateSpace
from .rates_from_logs import fit_logs
from .virtual_run import Wish

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from pbonet.analysis.allocation import Fit, Problem
    from pbonet.master.configuration import Place

    from .parallel_runs import Runs
    from .rates_from_logs import Fitted

FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Rates of the grid, as factors of the present ones."""
SECONDS = 5.0
"""Virtual time of a run in which the error counts."""
SAME = 1e-9
CLOSE = 1e-3
"""Relative difference of rates that is none."""


class RunAt(Struct, frozen=True, kw_only=True):
    """A run that was made."""

    rates: dict[str, float]
    """Hz of the tasks that are tuned."""
    error: float
    """Not a number where `fault` says why."""
    loads: dict[str, float]
    """Utilization of each RTPU."""
    allowed: bool
    """All deadlines are kept, within the limit, and none was missed."""
    why: str
    """``present``, ``grid``, ``fit`` or ``harmonic``; of a recorded run its file."""
    predicted: bool = False
    """It was not run: the error is that of the fit."""
    fault: str = ""
    """Why the run gives no error: a task failed, or it is not a finite number."""


class Tuning(Struct, frozen=True, kw_only=True):
    """The rates that are proposed, and the runs on which that rests."""

    job: str
    cost: str
    fit: Fit
    runs: list[RunAt]
    present: RunAt
    best: RunAt

    @property
    def rates(self) -> dict[str, float]:
        """The new Hz of each task whose rate changes."""
        before = self.present.rates
        return {n: hz for n, hz in self.best.rates.items() if hz != before[n]}


def tune(
    path: str | Path,
    place: Place,
    *,
    cost: str = "",
    tasks: Collection[str] = (),
    keep: Collection[str] = (),
    logs: Sequence[str | Path] = (),
    factors: Sequence[float] = FACTORS,
    seconds: float = SECONDS,
    settle: float = 1.0,
    limit: float | None = None,
    running: bool = False,
    host: str = "",
    assume: float | None = None,
    told: Callable[[int, int], None] = lambda _, __: None,
) -> tuple[Tuning, list[str]]:
    """Choose the rates of a job's tasks; return them and warnings.

    Args:
        path: The ``.job`` file.
        place: Has the folders with modules.
        cost: The error, as a COST line has it; that of the job if empty.
        tasks: Those that are tuned; all periodic ones that are not CRITICAL if empty.
        keep: Those that are not.
        logs: Recorded runs, or their folders, whose errors count in place of runs in
            virtual time.
        factors: Rates of the grid, as factors of the present ones.
        seconds: Virtual time of a run in which the error counts.
        settle: Time before that, virtual or recorded.
        limit: Share of a core that tasks may use; None: what the cores grant.
        running: Ask the agents what that is.
        host: The machine whose saved profiles count; this one if empty.
        assume: Share of its period that a cycle takes whose MAXC is not known.
        told: Called with the number of runs that have ended, and of all.

    Raises:
        ConfigError: A file is missing or wrong, or there is no cost.
        VerificationError: No rates keep all deadlines, or a time is not known.
        UnknownTaskError: A task is not in the job.
        LogError: A log is missing or wrong, or lacks a variable of the error.
        PbonetError: The job cannot be simulated, or `scipy` is not installed.
    """
    must_have_solver("tune")
    files = Files(path, Library(place.libraries))
    text = _cost(files, cost)
    host = host or here()
    known = (
        known_rtpus.ask_agents(files.sbs, place)
        if running
        else known_rtpus.as_stated(files.sbs, ())
    )
    problem, warnings = problem_of(files, known, host, assume=assume, limit=limit)
    names = _tuned(problem, tasks, keep)
    if logs:
        found = fit_logs(
            *(logs, problem, names),
            cost=text,
            table=files.table.variables,
            settle=settle,
        )
        tuning = _from_logs(found, text, files.read_job().file)
        return tuning, [*warnings, *found.warnings]
    wish = Wish(
        job=str(path),
        rates={},
        cost=text,
        seconds=seconds,
        settle=settle,
        libraries=[str(one) for one in place.libraries],
        host=host,
        assume=assume,
    )
    with parallel_runs(told) as runs:
        search = _Search(problem, runs, wish, names)
        return search.done(factors, files.read_job().file), warnings


def _from_logs(found: Fitted, cost: str, job: str) -> Tuning:
    """Return the choice by recorded runs and by what their fit predicts."""
    space, fit = found.space, found.fit

    def run_at(
        rates: Mapping[str, float], why: str, error: float | None, fault: str = ""
    ) -> RunAt:
        predicted = error is None
        if error is None:
            error = fit.error({name: 1 / hz for name, hz in rates.items()})
        return RunAt(
            rates=dict(rates),
            error=error,
            loads=space.loads(rates),
            allowed=not fault and space.keeps(rates),
            why=why,
            fault=fault,
            predicted=predicted,
        )

    runs = [
        run_at(
            {n: one.rates[n] for n in space.hz},
            Path(one.file).name,
            one.error,
            one.fault,
        )
        for one in found.runs
    ]
    present = next(
        (
            one
            for one in runs
            if not one.fault
            and all(abs(one.rates[n] / hz - 1) < CLOSE for n, hz in space.hz.items())
        ),
        None,
    )
    if present is None:
        runs.append(present := run_at(space.hz, "present", None))
    runs += [run_at(rates, why, None) for rates, why in found.proposals]
    allowed = [one for one in runs if one.allowed]
    if not allowed:
        raise _nothing_allowed(runs, space, job)
    best = min(allowed, key=lambda run: (run.error, sum(run.loads.values())))
    if present.allowed and best.error >= present.error * (1 - SAME):
        best = present
    return Tuning(job=job, cost=cost, fit=fit, runs=runs, present=present, best=best)


def _cost(files: Files, cost: str) -> str:
    """Return the error that counts.

    Raises:
        ConfigError: There is none, or it names what the table does not have.
    """
    job = files.read_job()
    line = Condition(cost, At("--cost", 1, 1)) if cost else job.cost
    if line is None:
        raise ConfigError(
            "the job does not say which error is to be small",
            where=job.file,
            expected="a line such as COST rms(Q_REF - Q_MEZ)",
            remedy="write it after POST, or give --cost",
        )
    cost_of(line)
    if problems := legality.check_cost(line, files.table.variables):
        raise legality.as_error(problems)
    return line.text


def _tuned(
    problem: Problem, tasks: Collection[str], keep: Collection[str]
) -> list[str]:
    """Return the tasks whose rates are chosen."""
    periodic = [
        item.name
        for item in problem.running
        if item.period and item.task.rmod.tasktype is TaskType.PERIODIC
    ]
    for name in (*tasks, *keep):
        if name not in periodic:
            raise UnknownTaskError(
                f"the job has no periodic task {name}",
                got=f"tasks: {', '.join(periodic)}",
                remedy=did_you_mean(name, periodic) or "name one of them",
            )
    free = [n for n in periodic if not problem.by_name[n].task.rmod.critical]
    found = [name for name in tasks or free if name not in keep]
    if not found:
        raise VerificationError(
            "no task is left whose rate can be chosen",
            expected="a periodic task that is not CRITICAL",
            remedy="name tasks with --task",
        )
    return found


class _Search:
    """The search for rates.

    Args:
        problem: The job's tasks and RTPUs.
        runs: Runs the job.
        wish: A run without rates.
        names: The tasks whose rates are chosen.
    """

    def __init__(
        self, problem: Problem, runs: Runs, wish: Wish, names: Sequence[str]
    ) -> None:
        self._runs, self._wish = runs, wish
        self._space = RateSpace(problem, names)
        self._hz = self._space.hz
        self._made: list[RunAt] = []

    def done(self, factors: Sequence[float], job: str) -> Tuning:
        """Make all runs; return the best."""
        self._run([
            (self._hz, "present"),
            *((one, "grid") for one in self._grid(factors)),
        ])
        good = [run for run in self._made if not run.fault]
        if not good:
            raise self._no_error()
        fit = fitted(
            [{n: 1 / hz for n, hz in run.rates.items()} for run in good],
            [run.error for run in good],
        )
        span = max(*factors, *(1 / f for f in factors))
        self._run(self._space.proposals(fit, span))
        allowed = [run for run in self._made if run.allowed]
        if not allowed:
            raise _nothing_allowed(self._made, self._space, self._wish.job)
        present = self._made[0]
        best = min(allowed, key=lambda run: (run.error, sum(run.loads.values())))
        if present.allowed and best.error >= present.error * (1 - SAME):
            best = present
        return Tuning(
            job=job,
            cost=self._wish.cost,
            fit=fit,
            runs=self._made,
            present=present,
            best=best,
        )

    def _grid(self, factors: Sequence[float]) -> list[dict[str, float]]:
        """Return the rates of the grid: each task's alone, and those of all at once."""
        found = [
            {**self._hz, name: hz * factor}
            for name, hz in self._hz.items()
            for factor in factors
        ]
        found += [{n: hz * factor for n, hz in self._hz.items()} for factor in factors]
        return [rates for rates in found if self._space.possible(rates)]

    def _run(self, wanted: Sequence[tuple[Mapping[str, float], str]]) -> None:
        """Make runs at rates that were not run at yet."""
        have = [run.rates for run in self._made]
        new: list[tuple[dict[str, float], str]] = []
        for rates, why in wanted:
            if dict(rates) not in [*have, *(one for one, _ in new)]:
                new.append((dict(rates), why))
        wishes = [structs.replace(self._wish, rates=rates) for rates, _ in new]
        for (rates, why), seen in zip(new, self._runs.results(wishes), strict=True):
            fault = seen.stopped or ("no finite number" * (seen.error is None))
            self._made.append(
                RunAt(
                    rates=rates,
                    error=math.nan if fault or seen.error is None else seen.error,
                    loads=self._space.loads(rates),
                    allowed=self._space.keeps(rates) and not seen.missing and not fault,
                    why=why,
                    fault=fault,
                )
            )

    def _no_error(self) -> VerificationError:
        return VerificationError(
            "no run gives an error, at any rates",
            where=self._wish.job,
            expected="a job that runs in virtual time, and a finite error",
            got=self._made[0].fault,
            remedy="correct COST or the module; 'pbonet simulate JOB --code' runs it",
        )


def _nothing_allowed(
    runs: Sequence[RunAt], space: RateSpace, job: str
) -> VerificationError:
    least = min(runs, key=lambda run: max(run.loads.values()))
    return VerificationError(
        "no rates that were tried keep all deadlines",
        where=job,
        expected=space.problem.limits,
        got=", ".join(f"{name} {load:.1%}" for name, load in least.loads.items())
        + " at the lowest rates",
        remedy="give smaller factors with --factor or logs of lower rates, tune more "
        "tasks, or move tasks with 'pbonet allocate'",
    )
