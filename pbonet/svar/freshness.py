"""The handling of the ages of the variables that a task reads; native in fresh.h."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from pbonet.config import Variable


class Action(IntEnum):
    """The action of a task while an input is too old; the largest of several counts."""

    GO_ON = 0
    HOLD = 1
    STABLE = 2
    SAFE = 3
    ERROR = 4


class Freshness(NamedTuple):
    """How a task handles the age of one variable."""

    max_age: float | None = None
    """Seconds; the MAXAGE of the variable counts, too, if it is less."""
    action: Action = Action.GO_ON
    passes: bool = True
    """Whether the age is passed on to what the task writes."""


def plan_limits(
    variables: Sequence[Variable],
    chosen: Sequence[int],
    freshness: Mapping[int, Freshness],
    written: Collection[int],
) -> list[tuple[int, int, bool]]:
    """Return limit in nanoseconds, action and passing on for variables of a plan.

    Args:
        variables: All variables of the table.
        chosen: The indices of the plan's variables.
        freshness: Of the in-vars, by index; other variables have no age.
        written: Indices of what the task writes: a task does not inherit its own age.
    """
    found: list[tuple[int, int, bool]] = []
    for index in chosen:
        one = freshness.get(index)
        if one is None:
            found.append((0, 0, False))
            continue
        given = (one.max_age, variables[index].maxage)
        limit = min((age for age in given if age is not None), default=0.0)
        passes = one.passes and index not in written
        found.append((round(limit * 1e9), int(one.action), passes))
    return found
