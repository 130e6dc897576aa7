"""Costs of an assignment: bytes between machines, and ages along the data flow.

The age of a chain is the time from the release of its first task, which samples, to
the end of the cycle of its last one that uses the sample, at worst::

    age = sum over its links of wait(u, v) + T of the last task
    wait(u, v) = 0                            both on one RTPU, and u always before v
               = T_u + R_u [+ latency]        else [on another machine]

R is the longest response, for which the schedulability test vouches with the period T.
On one RTPU u goes before v if v's period is a multiple of u's, because their releases
coincide (decision 0020), the earlier deadline goes first, and between equal ones the
user priority, which follows the data flow (Stewart 1994, section 6.2.4).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.legality import flow_order
from pbonet.config import TaskType

if TYPE_CHECKING:
    from collections.abc import Mapping

    from .assignment_problem import Item, Places, Problem


class Link(Struct, frozen=True, kw_only=True):
    """A task that reads what another one writes."""

    writer: str
    reader: str
    back: bool
    """It closes a control loop: a chain ends with the reader's cycle."""
    in_step: bool
    """On one RTPU the reader gets what the writer made of the same release."""
    wait: float
    """Seconds, where it does not."""


class Chain(Struct, frozen=True, kw_only=True):
    """The path of the oldest data that a task at the end of the data flow uses."""

    tasks: tuple[str, ...]
    seconds: float


class Cost(Struct, frozen=True, kw_only=True):
    """The cost of an assignment, and what it is made of."""

    traffic: float
    """Bytes a second that tasks read from other machines."""
    chains: tuple[Chain, ...]
    """One for each end of the data flow."""
    total: float
    """The weighted sum of both, each as a share of the greatest possible."""

    @property
    def age(self) -> float:
        """The sum of the ages of all chains."""
        return sum(chain.seconds for chain in self.chains)


class Flow:
    """The data flow among the tasks of a problem that are ON."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        tasks = [item.task for item in problem.running]
        self.order = flow_order(tasks)
        self._rank = {name: at for at, name in enumerate(self.order)}
        self.links = _links(problem, self._rank)
        self.readings = _readings(problem)
        away = {one.writer for one in self.links}
        timed = {item.name for item in problem.running if item.period}
        joined = {n for one in self.links for n in (one.writer, one.reader)}
        self.ends = [n for n in self.order if n in timed & joined and n not in away]
        self.loops = [one for one in self.links if one.back]
        self.most_traffic = sum(rate for rate, _, _ in self.readings) or 1.0
        self.most_age = self._most_age() or 1.0

    def wait(self, link: Link, places: Places) -> float:
        """Return what a link adds to the age."""
        machines = self.problem.machines
        here, there = places[link.reader], places[link.writer]
        if link.in_step and here == there:
            return 0.0
        far = machines[here] != machines[there]
        return link.wait + self.problem.latency * far

    def chains(self, places: Places) -> list[Chain]:
        """Return the oldest chain of each end of the data flow, and of each loop."""
        return self._chains({
            (one.writer, one.reader): self.wait(one, places) for one in self.links
        })

    def _chains(self, waits: Mapping[tuple[str, str], float]) -> list[Chain]:
        oldest: dict[str, tuple[float, tuple[str, ...]]] = {}
        for name in self.order:
            coming = [
                (oldest[one.writer][0] + waits[one.writer, name], one.writer)
                for one in self.links
                if one.reader == name and not one.back
            ]
            age, before = max(coming, default=(0.0, ""))
            path = oldest[before][1] if before else ()
            oldest[name] = age, (*path, name)
        items = self.problem.by_name
        found = [
            Chain(tasks=oldest[end][1], seconds=oldest[end][0] + items[end].period)
            for end in self.ends
        ]
        for one in self.loops:
            age, path = oldest[one.writer]
            age += waits[one.writer, one.reader] + items[one.reader].period
            found.append(Chain(tasks=(*path, one.reader), seconds=age))
        return found

    def _most_age(self) -> float:
        far = self.problem.latency
        waits = {(one.writer, one.reader): one.wait + far for one in self.links}
        return sum(chain.seconds for chain in self._chains(waits))

    def traffic(self, places: Places) -> float:
        """Return the bytes a second that tasks read from other machines.

        A variable that several tasks of a machine read counts there once.
        """
        machines = self.problem.machines
        total = 0.0
        for rate, writer, readers in self.readings:
            home = machines[places[writer]]
            total += rate * len({machines[places[name]] for name in readers} - {home})
        return total

    def cost(self, places: Places) -> Cost:
        """Return the cost of an assignment."""
        traffic, chains = self.traffic(places), self.chains(places)
        age = sum(chain.seconds for chain in chains)
        weight = self.problem.weight
        total = weight * traffic / self.most_traffic
        total += (1 - weight) * age / self.most_age
        return Cost(traffic=traffic, chains=tuple(chains), total=total)


Reading = tuple[float, str, tuple[str, ...]]
"""Bytes a second of a variable, its writer, and its readers."""


def _readings(problem: Problem) -> list[Reading]:
    found: list[Reading] = []
    for writer in problem.running:
        for variable in writer.task.outputs:
            readers = tuple(
                one.name
                for one in problem.running
                if variable in one.task.inputs and one is not writer
            )
            hz = min(writer.task.hz or 0.0, problem.rates.get(variable, float("inf")))
            if readers and (rate := problem.sizes.get(variable, 0) * hz):
                found.append((rate, writer.name, readers))
    return found


def _links(problem: Problem, rank: Mapping[str, int]) -> list[Link]:
    found: list[Link] = []
    timed = [item for item in problem.running if item.period]
    for writer in timed:
        for reader in timed:
            if writer is reader or not {*writer.task.outputs} & {*reader.task.inputs}:
                continue
            back = rank[reader.name] < rank[writer.name]
            found.append(
                Link(
                    writer=writer.name,
                    reader=reader.name,
                    back=back,
                    in_step=not back and _in_step(writer, reader),
                    wait=2 * writer.period,
                )
            )
    return found


def _in_step(writer: Item, reader: Item) -> bool:
    """Return whether the writer has ended each cycle before the reader's begins."""
    one, other = writer.task, reader.task
    periodic = all(t.rmod.tasktype is TaskType.PERIODIC for t in (one, other))
    if not periodic or one.rmod.softness:
        return False
    ranked = one.rmod.crit == other.rmod.crit or (
        one.rmod.crit is not None
        and other.rmod.crit is not None
        and one.rmod.crit > other.rmod.crit
    )
    mine, theirs = _ns(writer), _ns(reader)
    return ranked and theirs % mine == 0


def _ns(item: Item) -> int:
    return round(item.period * 1e9)
