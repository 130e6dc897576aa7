"""Do the conditions for leaving a job fit those for entering the next one?

Both must hold at the same instant (Stewart 1994, section 3.2). What can be judged
without values are comparisons of equal terms with numbers, and equal conditions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from .conditions import Bound, Part, parts

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pbonet.config import Condition, Variable


class Fit(Struct, frozen=True):
    """How conditions fit those that must hold with them."""

    conflicts: list[tuple[Condition, Condition]]
    """Pairs that can never hold together: the former one and the later one."""
    unsaid: list[Condition]
    """Later ones that do not follow from the former ones."""


def fit(
    former: Iterable[Condition],
    later: Iterable[Condition],
    variables: Sequence[Variable],
    known: Iterable[Condition] = (),
) -> Fit:
    """Return how conditions fit.

    Args:
        former: What must hold when a job is left.
        later: What must hold when the next one is entered.
        variables: What the ``.svar`` file defines.
        known: What held a moment before: it is no conflict, but may say enough.
    """
    left = [(one, parts(one, variables)) for one in former]
    seen = [part for _, found in left for part in found]
    seen += [part for one in known for part in parts(one, variables)]
    conflicts: list[tuple[Condition, Condition]] = []
    unsaid: list[Condition] = []
    for one in later:
        demanded = parts(one, variables)
        against = [cond for cond, found in left if _exclude(found, demanded)]
        conflicts += [(cond, one) for cond in against]
        if not against and not all(_follows(part, seen) for part in demanded):
            unsaid.append(one)
    return Fit(conflicts, unsaid)


def _exclude(found: Iterable[Part], demanded: Iterable[Part]) -> bool:
    """Return whether two conditions can never hold together."""
    bounds = [bound for part in found for bound in part.bounds]
    wanted = [bound for part in demanded for bound in part.bounds]
    return any(
        one.term == other.term and _empty(one, other)
        for one in bounds
        for other in wanted
    )


def _empty(one: Bound, other: Bound) -> bool:
    """Return whether no number is within both bounds."""
    low, open_low = max((one.low, one.open_low), (other.low, other.open_low))
    high, shut_high = min(
        (one.high, not one.open_high), (other.high, not other.open_high)
    )
    return low > high or (low == high and (open_low or not shut_high))


def _follows(part: Part, seen: Sequence[Part]) -> bool:
    """Return whether a part holds because others do."""
    if part.text in {one.text for one in seen}:
        return True
    bounds = [bound for one in seen for bound in one.bounds]
    return bool(part.bounds) and all(
        _at_least(wanted, bounds) and _at_most(wanted, bounds) for wanted in part.bounds
    )


def _at_least(wanted: Bound, bounds: Iterable[Bound]) -> bool:
    return wanted.low == float("-inf") or any(
        one.term == wanted.term
        and (one.low, one.open_low) >= (wanted.low, wanted.open_low)
        for one in bounds
    )


def _at_most(wanted: Bound, bounds: Iterable[Bound]) -> bool:
    return wanted.high == float("inf") or any(
        one.term == wanted.term
        and (one.high, not one.open_high) <= (wanted.high, not wanted.open_high)
        for one in bounds
    )
