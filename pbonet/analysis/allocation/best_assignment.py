"""Assigns tasks to RTPUs: the cheapest assignment that keeps every deadline.

The linear program limits the load of each RTPU. Where the test of section 6.2 asks for
more, as under RM, with servers or with a CRIT, each assignment that it refuses adds a
restriction: these tasks are not on that RTPU all at once. So what is found in the end
passes the test, and is the best of all that do.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import VerificationError

from .assignment_costs import Cost, Flow
from .assignment_problem import Problem, allowed, faults, keeps_deadlines
from .infeasibility import explained, without_room
from .linear_program import MOVE, Program

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.config import RtpuEntry

    from .assignment_problem import Places
    from .linear_program import Solution

SECONDS = 10.0
"""Time to look for an assignment, unless told otherwise."""
SAME = 1e-6
"""Difference of costs that is none."""


class Assignment(Struct, frozen=True, kw_only=True):
    """An assignment of tasks to RTPUs, beside the present one."""

    places: dict[str, str]
    """The RTPU of each task."""
    cost: Cost
    present: dict[str, str]
    before: Cost
    present_keeps: bool
    """The present one keeps all deadlines and pins."""
    gap: float
    """Share of the cost by which a better one may be cheaper; 0: this is the best."""
    seconds: float
    """How long it took."""
    refused: int
    """Sets of tasks that the schedulability test refused on the way."""

    @property
    def moved(self) -> list[str]:
        """The tasks that get another RTPU."""
        return [
            name for name, rtpu in self.places.items() if rtpu != self.present[name]
        ]


def assign(problem: Problem, seconds: float = SECONDS) -> Assignment:
    """Return the cheapest assignment that respects all restrictions.

    Args:
        problem: The tasks and RTPUs.
        seconds: The most that it may take. Then the best so far is returned, with the
            share by which another one may be cheaper.

    Raises:
        VerificationError: There is none, and why; or none was found in time.
    """
    begun = time.monotonic()
    without_room(problem)
    search = _Search(problem, begun + seconds)
    found = search.run()
    present = {item.name: item.present for item in problem.items}
    keeps = allowed(problem, present)
    if keeps and (found is None or not search.is_better(found, present)):
        found = present
    if found is None:
        raise VerificationError(
            "no assignment that keeps all deadlines was found in time",
            expected=f"one within {seconds:g} s",
            remedy="give it more time with --seconds",
        )
    return Assignment(
        places=dict(found),
        cost=search.flow.cost(found),
        present=present,
        before=search.flow.cost(present),
        present_keeps=keeps,
        gap=search.gap(found),
        seconds=time.monotonic() - begun,
        refused=search.refused,
    )


class _Search:
    """The search for an assignment.

    Args:
        problem: The problem.
        until: The time at which it ends.
    """

    def __init__(self, problem: Problem, until: float) -> None:
        self.problem, self._until = problem, until
        self.flow = Flow(problem)
        self._program = Program(problem, self.flow)
        self._bound = 0.0
        self.refused = 0

    def run(self) -> Places | None:
        """Return the best assignment that the test accepts; None: none in time.

        Raises:
            VerificationError: There is none.
        """
        while True:
            found = self._program.solve(self._until - time.monotonic())
            if found.impossible:
                raise explained(self.problem, self._program.forbidden)
            self._bound = max(self._bound, found.bound + self._program.fixed)
            if found.places is None:
                return None
            if not self._refuse(found):
                return found.places
            if time.monotonic() > self._until:
                return None

    def _refuse(self, found: Solution) -> bool:
        """Forbid what the test refuses in an assignment; return whether it did."""
        assert found.places is not None  # noqa: S101 - its caller has looked
        refused = False
        for rtpu, names in faults(self.problem, found.places):
            refused = True
            entry = self.problem.entry(rtpu)
            least = self._least(names, entry)
            self.refused += 1
            for other in self.problem.rtpus:
                if other is entry or not self._keeps(least, other):
                    self._program.forbid(least, other.name)
        return refused

    def _least(self, names: Sequence[str], entry: RtpuEntry) -> list[str]:
        """Return as few of the tasks as already miss deadlines together."""
        left = list(names)
        for name in names:
            fewer = [one for one in left if one != name]
            if not self._keeps(fewer, entry):
                left = fewer
        return left

    def _keeps(self, names: Sequence[str], entry: RtpuEntry) -> bool:
        items = [self.problem.by_name[name] for name in names]
        if any(entry.name not in item.tasks for item in items):
            return True  # they cannot all be there
        tasks = [item.tasks[entry.name] for item in items]
        return keeps_deadlines(tasks, entry, self.problem.core(entry.name))

    def _total(self, places: Places) -> float:
        """Return the cost of an assignment, with that of moving tasks."""
        items = self.problem.items
        moved = sum(places[item.name] != item.present for item in items)
        return self.flow.cost(places).total + MOVE * moved / len(items)

    def is_better(self, one: Places, other: Places) -> bool:
        """Return whether an assignment costs less than another one."""
        return self._total(one) < self._total(other) - SAME

    def gap(self, places: Places) -> float:
        """Return the share of the cost that a better assignment may save."""
        total = self._total(places)
        missing = total - self._bound
        return missing / total if missing > SAME else 0.0
