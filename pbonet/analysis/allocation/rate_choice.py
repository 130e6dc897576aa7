"""Chooses rates: a fit of the error over the periods, and its least within a load.

The error is fitted as ``c + sum(a_i T_i)`` with nothing below zero: what waits for a
task waits for a part of its period (Stewart 1994, section 6.2.4). Under a limit on
``sum(C_i / T_i)`` its least is where ``T_i`` goes with ``sqrt(C_i / a_i)``.
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

STEPS = 100
"""Halvings of the range in which the common factor is sought."""


class Fit(Struct, frozen=True, kw_only=True):
    """An error as a function of periods."""

    constant: float
    slopes: dict[str, float]
    """Error by second of a task's period."""
    quality: float
    """Share of the error's variance that the fit explains (R squared)."""

    def error(self, periods: Mapping[str, float]) -> float:
        """Return the error at these periods, in seconds."""
        return self.constant + sum(a * periods[n] for n, a in self.slopes.items())


def fitted(periods: Sequence[Mapping[str, float]], errors: Sequence[float]) -> Fit:
    """Return the fit of errors that were seen at these periods."""
    optimize: Any = import_module("scipy.optimize")
    names = list(periods[0])
    rows = np.array([[1.0, *(one[n] for n in names)] for one in periods])
    scale = rows.max(axis=0)
    scaled, _ = optimize.nnls(rows / scale, np.array(errors))
    found: NDArray[np.float64] = scaled / scale
    seen = np.array(errors)
    spread = float(((seen - seen.mean()) ** 2).sum())
    left = float(((seen - rows @ found) ** 2).sum())
    return Fit(
        constant=float(found[0]),
        slopes={n: float(a) for n, a in zip(names, found[1:], strict=True)},
        quality=1.0 - left / spread if spread else 1.0,
    )


def best_periods(
    fit: Fit,
    costs: Mapping[str, float],
    present: Mapping[str, float],
    load: float,
    span: float,
) -> dict[str, float]:
    """Return the periods on one core with the least fitted error.

    Tasks that the error does not depend on keep their period, if there is room.

    Args:
        fit: The error.
        costs: CPU seconds of a cycle of each task on the core that may change.
        present: Their present periods.
        load: Share of the core that they may have together.
        span: The factor by which a period may become longer or shorter.
    """
    matters = [name for name in costs if fit.slopes.get(name, 0.0) > 0 and costs[name]]
    periods = {name: present[name] for name in costs}
    for name in costs:
        if fit.slopes.get(name, 0.0) > 0 and not costs[name]:
            periods[name] = present[name] / span
    used = sum(costs[n] / periods[n] for n in costs if n not in matters)
    least = sum(costs[n] / (present[n] * span) for n in matters)
    if used + least > load:  # the others have to give way, too
        periods |= {n: present[n] * span for n in costs if n not in matters}
        used = sum(costs[n] / periods[n] for n in costs if n not in matters)

    def at(factor: float) -> dict[str, float]:
        return {
            name: min(
                max(
                    factor * (costs[name] / fit.slopes[name]) ** 0.5,
                    present[name] / span,
                ),
                present[name] * span,
            )
            for name in matters
        }

    wanted = [present[n] / (costs[n] / fit.slopes[n]) ** 0.5 for n in matters]
    low, high = (min(wanted) / span, max(wanted) * span) if wanted else (1.0, 1.0)
    for _ in range(STEPS):
        middle = (low * high) ** 0.5
        chosen = at(middle)
        if used + sum(costs[n] / chosen[n] for n in matters) > load:
            low = middle
        else:
            high = middle
    return periods | at(high)


def harmonic(periods: Mapping[str, float]) -> dict[str, float]:
    """Return periods near these, each a power of two times the shortest one."""
    if not periods:
        return {}
    base = min(periods.values())
    return {
        name: base * 2.0 ** max(0, round(float(np.log2(period / base))))
        for name, period in periods.items()
    }


def in_step_rates(periods: Mapping[str, float]) -> dict[str, float]:
    """Return rates of few digits whose releases coincide, not above those given.

    A period is a whole number of nanoseconds: those of 178 and 89 Hz are no multiples
    of each other, and their releases drift apart. So the fastest rate is lowered until
    all are.

    Args:
        periods: Periods that are about multiples of the shortest one.
    """
    if not periods:
        return {}
    base = min(periods.values())
    times = {name: round(period / base) for name, period in periods.items()}
    hz = rounded_down(1 / base)
    while any(_ns(n / hz) != n * _ns(1 / hz) for n in times.values()):
        hz = rounded_down(hz * (1 - 1e-3))
    return {name: hz / n for name, n in times.items()}


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def rounded_down(hz: float) -> float:
    """Return a frequency rounded down to three digits."""
    if hz <= 0:
        return 0.0
    digits = 2 - math.floor(math.log10(hz))
    return round(math.floor(hz * 10.0**digits * (1 + 1e-12)) / 10.0**digits, digits)
