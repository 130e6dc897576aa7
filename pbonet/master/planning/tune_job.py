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

from pbonet.analysis import allocation, legality
from pbonet.analysis.allocation import (
    best_periods,
    fitted,
    harmonic,
    in_step_rates,
)
from pbonet.config import Condition, Library, Place as At, TaskType, cost_of
from pbonet.errors import ConfigError, UnknownTaskError, VerificationError, did_you_mean
from pbonet.master.configuration import Files, here

from . import known_rtpus
from .allocate_job import must_have_solver
from .allocation_problem import problem_of
from .parallel_runs import parallel_runs
from .virtual_run import Wish

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from pbonet.analysis.allocation import Fit, Problem
    from pbonet.master.configuration import Place

    from .parallel_runs import Runs

FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Rates of the grid, as factors of the present ones."""
SAME = 1e-9
ROUNDED = 1 + 1e-6
"""Periods are whole nanoseconds."""


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
    """``present``, ``grid``, ``fit`` or ``harmonic``."""
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
    factors: Sequence[float] = FACTORS,
    seconds: float = 5.0,
    settle: float = 1.0,
    limit: float = 0.95,
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
        factors: Rates of the grid, as factors of the present ones.
        seconds: Virtual time of a run in which the error counts.
        settle: Virtual time before that.
        limit: Share of a core that tasks may use.
        host: The machine whose saved profiles count; this one if empty.
        assume: Share of its period that a cycle takes whose MAXC is not known.
        told: Called with the number of runs that have ended, and of all.

    Raises:
        ConfigError: A file is missing or wrong, or there is no cost.
        VerificationError: No rates keep all deadlines, or a time is not known.
        UnknownTaskError: A task is not in the job.
        PbonetError: The job cannot be simulated, or `scipy` is not installed.
    """
    must_have_solver("tune")
    files = Files(path, Library(place.libraries))
    text = _cost(files, cost)
    host = host or here()
    known = known_rtpus.as_stated(files.sbs, ())
    problem, warnings = problem_of(files, known, host, assume=assume, limit=limit)
    names = _tuned(problem, tasks, keep)
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
        self._problem, self._runs, self._wish = problem, runs, wish
        self._hz = {n: 1.0 / problem.by_name[n].period for n in names}
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
        periods = self._best(fit, max(*factors, *(1 / f for f in factors)))
        near = self._made_to_fit(harmonic(periods))
        more = [(_rates(periods), "fit"), (in_step_rates(near), "harmonic")]
        self._run([one for one in more if self._possible(one[0])])
        allowed = [run for run in self._made if run.allowed]
        if not allowed:
            raise self._nothing_allowed()
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
        return [rates for rates in found if self._possible(rates)]

    def _possible(self, rates: Mapping[str, float]) -> bool:
        """Return whether each cycle fits into its period, as a start demands."""
        items = self._problem.by_name
        return all((items[n].task.worst or 0.0) * hz <= 1.0 for n, hz in rates.items())

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
                    loads=self._loads(rates),
                    allowed=self._allowed(rates) and not seen.missing and not fault,
                    why=why,
                    fault=fault,
                )
            )

    def _on(self, rtpu: str, rates: Mapping[str, float]) -> list[legality.Task]:
        """Return the tasks that are ON on an RTPU, at these rates."""
        return [
            structs.replace(item.task, freq=rates.get(item.name, item.task.freq))
            for item in self._problem.running
            if item.present == rtpu
        ]

    def _loads(self, rates: Mapping[str, float]) -> dict[str, float]:
        return {
            entry.name: sum(map(allocation.share, self._on(entry.name, rates)))
            for entry in self._problem.rtpus
        }

    def _allowed(self, rates: Mapping[str, float]) -> bool:
        return all(
            allocation.keeps_deadlines(tasks, entry, self._problem.limit)
            for entry in self._problem.rtpus
            if (tasks := self._on(entry.name, rates))
        )

    def _best(self, fit: Fit, span: float) -> dict[str, float]:
        """Return the periods with the least fitted error, RTPU by RTPU."""
        found: dict[str, float] = {}
        for entry in self._problem.rtpus:
            here = [i for i in self._problem.running if i.present == entry.name]
            mine = [item for item in here if item.name in self._hz]
            others = sum(allocation.share(i.task) for i in here if i not in mine)
            found |= best_periods(
                fit,
                {i.name: allocation.share(i.task) * i.period for i in mine},
                {i.name: i.period for i in mine},
                self._problem.limit - others,
                span,
            )
        return found

    def _made_to_fit(self, periods: Mapping[str, float]) -> dict[str, float]:
        """Return periods of the same ratios that are long enough for every RTPU."""
        rates = {name: 1 / period for name, period in periods.items()}
        scale = 1.0
        for entry in self._problem.rtpus:
            here = self._on(entry.name, rates)
            mine = sum(allocation.share(t) for t in here if t.name in self._hz)
            others = sum(allocation.share(t) for t in here if t.name not in self._hz)
            if mine and self._problem.limit > others:
                scale = max(scale, mine / (self._problem.limit - others))
        scale *= ROUNDED if scale > 1 else 1.0
        return {name: period * scale for name, period in periods.items()}

    def _no_error(self) -> VerificationError:
        return VerificationError(
            "no run gives an error, at any rates",
            where=self._wish.job,
            expected="a job that runs in virtual time, and a finite error",
            got=self._made[0].fault,
            remedy="correct COST or the module; 'pbonet simulate JOB --code' runs it",
        )

    def _nothing_allowed(self) -> VerificationError:
        least = min(self._made, key=lambda run: max(run.loads.values()))
        return VerificationError(
            "no rates of the grid keep all deadlines",
            where=self._wish.job,
            expected=f"at most {self._problem.limit:.1%} of each core",
            got=", ".join(f"{name} {load:.1%}" for name, load in least.loads.items())
            + " at the lowest rates",
            remedy="give smaller factors with --factor, tune more tasks, or move tasks "
            "with 'pbonet allocate'",
        )


def _rates(periods: Mapping[str, float]) -> dict[str, float]:
    """Return rates with few digits, not above those of the periods."""
    return {name: allocation.rounded_down(1 / t) for name, t in periods.items()}
