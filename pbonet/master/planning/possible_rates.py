"""The rates that tasks may have: what they take of the cores, and the best by a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.analysis import allocation
from pbonet.analysis.allocation import best_periods, harmonic, in_step_rates

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pbonet.analysis import legality
    from pbonet.analysis.allocation import Fit, Problem

ROUNDED = 1 + 1e-6
"""Periods are whole nanoseconds."""


class RateSpace:
    """The rates of some tasks of a job.

    Args:
        problem: The job's tasks and RTPUs.
        names: The tasks whose rates are chosen.
    """

    def __init__(self, problem: Problem, names: Sequence[str]) -> None:
        self.problem = problem
        self.hz = {n: 1.0 / problem.by_name[n].period for n in names}
        """Their present rates."""

    def proposals(self, fit: Fit, span: float) -> list[tuple[dict[str, float], str]]:
        """Return the rates with the least fitted error, and harmonic ones near these.

        Args:
            fit: The error over the periods.
            span: The factor by which a rate may become higher or lower.
        """
        periods = self._best(fit, span)
        near = self._made_to_fit(harmonic(periods))
        found = [(_rates(periods), "fit"), (in_step_rates(near), "harmonic")]
        return [one for one in found if self.possible(one[0])]

    def possible(self, rates: Mapping[str, float]) -> bool:
        """Return whether each cycle fits into its period, as a start demands."""
        items = self.problem.by_name
        return all((items[n].task.worst or 0.0) * hz <= 1.0 for n, hz in rates.items())

    def on(self, rtpu: str, rates: Mapping[str, float]) -> list[legality.Task]:
        """Return the tasks that are ON on an RTPU, at these rates."""
        return [
            structs.replace(item.task, freq=rates.get(item.name, item.task.freq))
            for item in self.problem.running
            if item.present == rtpu
        ]

    def loads(self, rates: Mapping[str, float]) -> dict[str, float]:
        """Return the utilization of each RTPU by the tasks that are ON."""
        return {
            entry.name: sum(map(allocation.share, self.on(entry.name, rates)))
            for entry in self.problem.rtpus
        }

    def keeps(self, rates: Mapping[str, float]) -> bool:
        """Return whether all deadlines are kept, within what the cores grant."""
        return all(
            allocation.keeps_deadlines(tasks, entry, self.problem.core(entry.name))
            for entry in self.problem.rtpus
            if (tasks := self.on(entry.name, rates))
        )

    def _best(self, fit: Fit, span: float) -> dict[str, float]:
        """Return the periods with the least fitted error, RTPU by RTPU."""
        found: dict[str, float] = {}
        for entry in self.problem.rtpus:
            here = [i for i in self.problem.running if i.present == entry.name]
            mine = [item for item in here if item.name in self.hz]
            load = self.problem.load
            others = sum(load(i, entry.name) for i in here if i not in mine)
            found |= best_periods(
                fit,
                {i.name: load(i, entry.name) * i.period for i in mine},
                {i.name: i.period for i in mine},
                self.problem.core(entry.name).share - others,
                span,
            )
        return found

    def _made_to_fit(self, periods: Mapping[str, float]) -> dict[str, float]:
        """Return periods of the same ratios that are long enough for every RTPU."""
        rates = {name: 1 / period for name, period in periods.items()}
        scale = 1.0
        for entry in self.problem.rtpus:
            core = self.problem.core(entry.name)
            mine = others = 0.0
            for task in self.on(entry.name, rates):
                load = allocation.share(task) + core.dispatch * (task.hz or 0.0)
                if task.name in self.hz:
                    mine += load
                else:
                    others += load
            if mine and core.share > others:
                scale = max(scale, mine / (core.share - others))
        scale *= ROUNDED if scale > 1 else 1.0
        return {name: period * scale for name, period in periods.items()}


def _rates(periods: Mapping[str, float]) -> dict[str, float]:
    """Return rates with few digits, not above those of the periods."""
    return {name: allocation.rounded_down(1 / t) for name, t in periods.items()}
