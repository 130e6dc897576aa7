"""The mixed-integer linear program of an assignment, for `scipy.optimize.milp`.

Its variables are, for each task and RTPU that it may run on, whether it runs there;
for each variable and machine whether it is carried there; for each link whether it goes
to another RTPU, and to another machine; and the age at each task. Only the first are
integers: the others follow from them.
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from .assignment_problem import FOLLOWS, Places

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from .assignment_costs import Flow, Link
    from .assignment_problem import Item, Problem

MOVE = 1e-4
"""Cost of moving all tasks: of two equally good assignments the nearer one is found."""
Terms = list[tuple[int, float]]
"""Variables with their coefficients."""


class Program:
    """The program of a problem; see the module's description.

    Args:
        problem: The problem.
        flow: Its data flow.
        elastic: Have the load of each RTPU exceed the limit, at the cost of the excess
            alone: what is found says how much is missing, and where.
    """

    def __init__(self, problem: Problem, flow: Flow, *, elastic: bool = False) -> None:
        self.problem, self.flow = problem, flow
        self.cost: list[float] = []
        self._low: list[float] = []
        self._high: list[float] = []
        self._whole: list[int] = []
        self._rows: list[tuple[Terms, float, float]] = []
        self._on: dict[tuple[str, str], int] = {}
        self.excess: dict[str, int] = {}
        self.forbidden: list[tuple[str, Sequence[str]]] = []
        """RTPUs, each with tasks that must not be there all at once."""
        self._place_tasks()
        self._standbys()
        if elastic:
            self._allow_excess()
        self._loads()
        if not elastic:
            self._traffic()
            self._ages()
            self._moves()

    # -- its parts

    def _variable(
        self, cost: float = 0.0, high: float = math.inf, *, whole: bool = False
    ) -> int:
        self.cost.append(cost)
        self._low.append(0.0)
        self._high.append(high)
        self._whole.append(int(whole))
        return len(self.cost) - 1

    def _row(
        self, terms: Terms, *, low: float = -math.inf, high: float = math.inf
    ) -> None:
        self._rows.append((terms, low, high))

    def on(self, task: str, rtpu: str) -> Terms:
        """Return whether a task is on an RTPU; nothing where it may not be."""
        at = self._on.get((task, rtpu))
        return [] if at is None else [(at, 1.0)]

    def at(self, task: str, machine: str) -> Terms:
        """Return whether a task is on a machine."""
        return [
            term
            for rtpu, home in self.problem.machines.items()
            if home == machine
            for term in self.on(task, rtpu)
        ]

    def _place_tasks(self) -> None:
        for item in self.problem.items:
            if item.pin.startswith(FOLLOWS):
                continue
            for rtpu in item.tasks:
                self._on[item.name, rtpu] = self._variable(high=1.0, whole=True)
            terms = [self._on[item.name, rtpu] for rtpu in item.tasks]
            self._row([(one, 1.0) for one in terms], low=1.0, high=1.0)
        for item in self.problem.items:
            if item.pin.startswith(FOLLOWS):
                for rtpu in item.tasks:
                    self._on[item.name, rtpu] = self._on[item.fallback_of, rtpu]

    def _standbys(self) -> None:
        """Keep those that take over by themselves away from their originals."""
        machines = self.problem.machines
        home = machines[self.problem.keeper]
        for item in self.problem.standbys:
            if not item.apart:
                continue
            for machine in dict.fromkeys(machines.values()):
                here = self.at(item.name, machine)
                there = self.at(item.fallback_of, machine)
                self._row([*here, *there], high=1.0)
                if machine == home:
                    self._row(there, high=0.0)

    def _allow_excess(self) -> None:
        for entry in self.problem.rtpus:
            self.excess[entry.name] = self._variable(1.0)

    def _loads(self) -> None:
        """Limit the load of each RTPU, also once standbys are engaged."""
        problem = self.problem
        gone = {one.fallback_of for one in problem.standbys}
        on = problem.running
        cases = [[*on]]
        for standby in problem.standbys:
            cases.append([one for one in on if one.name != standby.fallback_of])
            cases[-1].append(standby)
        if len(problem.standbys) > 1:
            cases.append([one for one in on if one.name not in gone])
            cases[-1] += problem.standbys
        for entry in problem.rtpus:
            for case in cases:
                self._load(entry.name, case)

    def _load(self, rtpu: str, items: Iterable[Item]) -> None:
        terms: Terms = []
        for item in items:
            if rtpu in item.tasks:
                share = self.problem.load(item, rtpu)
                terms += [(at, share) for at, _ in self.on(item.name, rtpu)]
        if rtpu in self.excess:
            terms.append((self.excess[rtpu], -1.0))
        self._row(terms, high=self.problem.core(rtpu).share)

    def _traffic(self) -> None:
        scale = self.problem.weight / self.flow.most_traffic
        machines = dict.fromkeys(self.problem.machines.values())
        for rate, writer, readers in self.flow.readings:
            for machine in machines:
                carried = self._variable(rate * scale, 1.0)
                for reader in readers:
                    self._at_least(
                        carried, self.at(reader, machine), self.at(writer, machine)
                    )

    def _at_least(self, variable: int, one: Terms, other: Terms) -> None:
        """Have a variable be at least the difference of two sums."""
        terms = [(variable, 1.0)]
        terms += [(at, -factor) for at, factor in one]
        terms += [(at, factor) for at, factor in other]
        self._row(terms, low=0.0)

    def _ages(self) -> None:
        scale = (1 - self.problem.weight) / self.flow.most_age
        age = {name: self._variable() for name in self.flow.order}
        for name in self.flow.ends:
            self.cost[age[name]] += scale
        for link in self.flow.links:
            end = self._variable(scale) if link.back else age[link.reader]
            terms, fixed = self._wait(link)
            back = [(at, -factor) for at, factor in terms]
            self._row([(end, 1.0), (age[link.writer], -1.0), *back], low=fixed)

    def _wait(self, link: Link) -> tuple[Terms, float]:
        """Return what a link adds to the age: a sum of variables, and a number."""
        far = self._parted(link, dict.fromkeys(self.problem.machines.values()), self.at)
        terms = [(far, self.problem.latency)]
        if not link.in_step:
            return terms, link.wait
        names = [entry.name for entry in self.problem.rtpus]
        return [*terms, (self._parted(link, names, self.on), link.wait)], 0.0

    def _parted(
        self, link: Link, places: Iterable[str], here: Callable[[str, str], Terms]
    ) -> int:
        """Return a variable that is 1 if the ends of a link are at other places.

        It is what is left of 1 after all places at which both are: that leaves less
        room for fractions than differences of each place do.
        """
        parted = self._variable(0.0, 1.0)
        terms: Terms = [(parted, 1.0)]
        for place in places:
            both = self._variable(0.0, 1.0)
            for end in (link.reader, link.writer):
                less = [(at, -factor) for at, factor in here(end, place)]
                self._row([(both, 1.0), *less], high=0.0)
            terms.append((both, 1.0))
        self._row(terms, low=1.0)
        return parted

    def _moves(self) -> None:
        part = MOVE / len(self.problem.items)
        for item in self.problem.items:
            for rtpu in item.tasks:
                if rtpu != item.present:
                    for at, _ in self.on(item.name, rtpu):
                        self.cost[at] += part

    # -- further restrictions

    def forbid(self, tasks: Sequence[str], rtpu: str) -> None:
        """Have these tasks not be on an RTPU all at once."""
        terms = [term for name in tasks for term in self.on(name, rtpu)]
        self._row(terms, high=len(terms) - 1.0)
        self.forbidden.append((rtpu, tasks))

    # -- solving

    @property
    def fixed(self) -> float:
        """The part of the cost that is the same for every assignment."""
        flow, items = self.flow, self.problem.by_name
        last = [*flow.ends, *(link.reader for link in flow.loops)]
        periods = sum(items[name].period for name in last)
        return (1 - self.problem.weight) * periods / flow.most_age

    def solve(self, seconds: float) -> Solution:
        """Return the best assignment that is found in a time.

        Args:
            seconds: The most that it may take.
        """
        optimize: Any = import_module("scipy.optimize")
        sparse: Any = import_module("scipy.sparse")
        rows, columns, values = _entries(self._rows)
        shape = len(self._rows), len(self.cost)
        matrix = sparse.csr_array((values, (rows, columns)), shape=shape)
        low = [row[1] for row in self._rows]
        high = [row[2] for row in self._rows]
        found = optimize.milp(
            np.array(self.cost),
            integrality=np.array(self._whole),
            bounds=optimize.Bounds(np.array(self._low), np.array(self._high)),
            constraints=optimize.LinearConstraint(matrix, low, high),
            options={"time_limit": max(seconds, 0.05), "mip_rel_gap": 1e-6},
        )
        bound = getattr(found, "mip_dual_bound", None)
        return Solution(
            places=None if found.x is None else self._places(found.x),
            excess={
                rtpu: float(found.x[at])
                for rtpu, at in self.excess.items()
                if found.x is not None
            },
            bound=-math.inf if bound is None else float(bound),
            impossible=found.status == _IMPOSSIBLE,
            proven=found.status == 0,
        )

    def _places(self, values: np.ndarray) -> Places:
        return {
            item.name: max(
                item.tasks, key=lambda rtpu: values[self._on[item.name, rtpu]]
            )
            for item in self.problem.items
        }


_IMPOSSIBLE = 2
"""Status of `milp`: there is no solution."""


class Solution(Struct, frozen=True, kw_only=True):
    """The result of solving a program."""

    places: Places | None
    """None: nothing was found in time, or there is none."""
    excess: dict[str, float]
    """Of an elastic program: what each RTPU has too much."""
    bound: float
    """No assignment costs less."""
    impossible: bool
    proven: bool
    """It is the best one."""


def _entries(
    rows: Sequence[tuple[Terms, float, float]],
) -> tuple[list[int], list[int], list[float]]:
    """Return row, column and value of each coefficient."""
    flat = [(at, *term) for at, (terms, _, _) in enumerate(rows) for term in terms]
    return (
        [at for at, _, _ in flat],
        [column for _, column, _ in flat],
        [value for _, _, value in flat],
    )
