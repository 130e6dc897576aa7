"""The error of a run: the mean over time that a COST line declares."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pbonet.analysis import legality
from pbonet.config import Condition, cost_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from pbonet.config import Variable

INSTANTS = 4000
"""Instants at which the error is taken, evenly spread over the run."""


def error_of(
    cost: str,
    table: Sequence[Variable],
    values_at: Callable[[str, NDArray[np.float64]], NDArray[np.float64]],
    begin: float,
    end: float,
) -> float | None:
    """Return the error of a run; None: it is no finite number.

    Args:
        cost: As a COST line has it.
        table: The variables in it.
        values_at: Returns the values of a variable at some times, shape ``(n, size)``.
        begin: When the error begins to count, in the unit of those times.
        end: Until when it counts.
    """
    mean, parsed = cost_of(Condition(cost))
    at = np.linspace(begin, end, INSTANTS, endpoint=False)
    columns = {name: values_at(name, at) for name in parsed.variables}
    rows = np.hstack([*columns.values()])
    first = [0, *(np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1)]
    found = np.array([
        legality.amounts(
            Condition(cost), table, {n: rows[i] for n, rows in columns.items()}
        )
        for i in first  # until the next of them all values are the same
    ])
    error = MEANS[mean](np.repeat(found, np.diff([*first, INSTANTS]), axis=0))
    return error if np.isfinite(error) else None


def last_before(
    times: Sequence[float] | NDArray[np.float64],
    values: NDArray[np.float64],
    at: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the value at each instant; the first one before that."""
    newest = np.searchsorted(times, at, side="right") - 1
    found: NDArray[np.float64] = values.take(np.maximum(newest, 0), axis=0)
    return found


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _mean(values: NDArray[np.float64]) -> float:
    return float(np.mean(np.abs(values)))


def _peak(values: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(values)))


MEANS = {"rms": _rms, "mean": _mean, "peak": _peak}
"""The means of a COST line."""
