"""``pbonet tune --from-log``: rates by the errors of recorded runs.

The runs were made at different rates. The error is fitted over the periods as it is for
runs in virtual time; the rates that the fit proposes were not run, so their error is a
prediction.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pbonet.analysis.allocation import fitted
from pbonet.config import Condition, cost_of
from pbonet.errors import VerificationError
from pbonet.log import Log

from .possible_rates import RateSpace
from .run_error import error_of, last_before

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from pbonet.analysis.allocation import Fit, Problem
    from pbonet.config import Variable
    from pbonet.log import Series

SAME = 1e-3
"""Relative difference of rates that is none."""


class RecordedRun(NamedTuple):
    """A recorded run of a job."""

    file: str
    rates: dict[str, float]
    """Hz of the tasks that may be tuned."""
    error: float
    """Not a number where `fault` says why."""
    fault: str


class Fitted(NamedTuple):
    """The errors of recorded runs over the periods of the tasks that differ in them."""

    runs: list[RecordedRun]
    space: RateSpace
    """Of the tasks whose rates differ in the runs."""
    fit: Fit
    proposals: list[tuple[dict[str, float], str]]
    """Rates with the least fitted error, within those of the runs."""
    warnings: list[str]


def fit_logs(
    paths: Sequence[str | Path],
    problem: Problem,
    names: Sequence[str],
    *,
    cost: str,
    table: Sequence[Variable],
    settle: float,
) -> Fitted:
    """Return the fit of the errors of recorded runs.

    Args:
        paths: Logs, or folders of runs.
        problem: The job's tasks and RTPUs.
        names: Tasks whose rates may be chosen.
        cost: The error.
        table: The variables of the job.
        settle: Seconds of each run before the error counts.

    Raises:
        LogError: A log is missing or wrong, or lacks a variable of the error.
        UnknownTaskError: A log lacks a task.
        VerificationError: The runs do not tell how the error depends on rates.
    """
    runs = [_recorded(Log(one), names, cost, table, settle) for one in paths]
    good = [one for one in runs if not one.fault]
    if not good:
        raise VerificationError(
            "no recorded run gives an error",
            expected="runs of the job at different rates",
            got="; ".join(f"{one.file}: {one.fault}" for one in runs),
            remedy="record others, or leave --from-log out for runs in virtual time",
        )
    varied = [name for name in names if _differs([one.rates[name] for one in good])]
    periods = [{name: 1 / one.rates[name] for name in varied} for one in good]
    rows = np.array([[1.0, *one.values()] for one in periods])
    if not varied or np.linalg.matrix_rank(rows) <= len(varied):
        raise _too_few(good, varied or names)
    fit = fitted(periods, [one.error for one in good])
    space = RateSpace(problem, varied)
    least = {name: min(one.rates[name] for one in good) for name in varied}
    most = {name: max(one.rates[name] for one in good) for name in varied}
    span = max(max(most[n] / hz, hz / least[n]) for n, hz in space.hz.items())
    proposals = [
        ({n: min(max(hz, least[n]), most[n]) for n, hz in rates.items()}, why)
        for rates, why in space.proposals(fit, span)
    ]
    return Fitted(runs, space, fit, proposals, [*_doubts(good, problem, names, varied)])


def _recorded(
    log: Log,
    names: Sequence[str],
    cost: str,
    table: Sequence[Variable],
    settle: float,
) -> RecordedRun:
    """Return a run's rates and its error."""
    changed = {
        str(one.get("task")) for one in log.events() if one.get("code") == "FREQ"
    }
    rates = {name: _rate(log, name) for name in names}
    moved = [name for name in names if name in changed or not rates[name]]
    if moved:
        fault = f"{moved[0]} had no single rate in it"
        return RecordedRun(str(log.path), rates, math.nan, fault)
    _, parsed = cost_of(Condition(cost))
    found = [one for name in parsed.variables for one in table if one.name == name]
    series = {name: log.series(name) for name in parsed.variables}
    if fault := _misshaped(found, series):
        return RecordedRun(str(log.path), rates, math.nan, fault)
    ends = [(one.seconds[0], one.seconds[-1]) for one in series.values() if len(one[0])]
    begin = max((first for first, _ in ends), default=0.0) + settle
    end = min((last for _, last in ends), default=0.0)
    if len(ends) < len(series) or end <= begin:
        fault = f"it is not longer than the {settle:g} s of --settle"
        return RecordedRun(str(log.path), rates, math.nan, fault)

    def values_at(name: str, at: NDArray[np.float64]) -> NDArray[np.float64]:
        seconds, values = series[name]
        return last_before(seconds, values.reshape(len(values), -1), at)

    error = error_of(cost, found, values_at, begin, end)
    fault = "" if error is not None else "no finite number"
    return RecordedRun(str(log.path), rates, math.nan if fault else error or 0.0, fault)


def _misshaped(variables: Sequence[Variable], series: Mapping[str, Series]) -> str:
    """Return which variable has another size in a run than in the job, if one has."""
    for one in variables:
        values = series[one.name].values
        size = math.prod(values.shape[1:])
        if len(values) and size != one.nelem:
            return f"{one.name} has {size} elements in it, and {one.nelem} in the job"
    return ""


def _rate(log: Log, task: str) -> float:
    """Return the rate of a task in a run, Hz; 0: it had none, or several."""
    found = {life.about.freq or 0.0 for life in log.lives(task)}
    return found.pop() if len(found) == 1 else 0.0


def _differs(rates: Sequence[float]) -> bool:
    return max(rates) > min(rates) * (1 + SAME)


def _too_few(good: Sequence[RecordedRun], names: Sequence[str]) -> VerificationError:
    every = [", ".join(f"{n} {one.rates[n]:g} Hz" for n in names) for one in good]
    return VerificationError(
        f"{len(good)} runs do not tell how the error depends on the rates of "
        + " and ".join(names),
        expected=f"at least {len(names) + 1} runs, in which each of them has a rate "
        "that does not follow from the others'",
        got="; ".join(every),
        remedy="record more runs at other rates, or name fewer tasks with --task",
    )


def _doubts(
    good: Sequence[RecordedRun],
    problem: Problem,
    names: Sequence[str],
    varied: Sequence[str],
) -> list[str]:
    """Return warnings about tasks whose rates are the same in all runs."""
    found: list[str] = []
    for name in names:
        if name in varied:
            continue
        had, now = good[0].rates[name], 1.0 / problem.by_name[name].period
        text = f"all runs have {name} at {had:g} Hz, so its rate is not chosen"
        if _differs([had, now]):
            text += f"; the job has it at {now:g} Hz, for which the errors do not hold"
        found.append(text)
    return found
