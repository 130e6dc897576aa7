"""PRE and POST: what must hold before a job is entered or left (section 3.2).

Judged on values of one instant; `condition_gate` asks an RTPU for them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.analysis import legality
from pbonet.config import Condition
from pbonet.errors import ConditionError
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pbonet.config import JobFile, Variable

    Look = Callable[[list[str]], list[m.VarValue]]

_TRIES: Final = 50
"""Reads of the table until its values are proven to be of one instant."""


class Asked(Struct, frozen=True):
    """One condition, and its job."""

    keyword: str
    job: str
    condition: Condition

    def text(self, outcome: legality.Outcome) -> str:
        """Return its result."""
        word = "holds" if outcome.holds else "does not hold"
        seen = f" (seen: {outcome.seen})" if outcome.seen else ""
        return f"{self.keyword} of {self.job} {word}: {self.condition.text}{seen}"


def must_be_answerable(job: JobFile, variables: Sequence[Variable]) -> None:
    """Refuse conditions that the table cannot answer.

    Raises:
        VerificationError: A variable is unknown, or sizes or units do not fit.
    """
    problems = legality.check_conditions([*job.pre, *job.post], variables)
    if problems:
        raise legality.as_error(problems)


def must_hold(
    asked: Sequence[Asked], variables: Sequence[Variable], look: Look
) -> list[str]:
    """Return conditions that all hold, with their measured values.

    Args:
        asked: The conditions.
        variables: What the ``.svar`` file defines.
        look: Returns values of variables.

    Raises:
        ConditionError: One does not hold.
    """
    if not asked:
        return []
    values = _of_one_instant(legality.named(one.condition for one in asked), look)
    numbers = {one.name: _numbers(one) for one in values}
    stale = [one.name for one in values if one.stale]
    told: list[str] = []
    missed: list[str] = []
    place = ""
    for one in asked:
        outcome = legality.evaluate(one.condition, variables, numbers, stale)
        told.append(one.text(outcome))
        if not outcome.holds:
            missed.append(told[-1])
            place = place or str(one.condition.place or "")
    if missed:
        lines = "".join(f"\n{n}. {text}" for n, text in enumerate(missed, 1))
        several = f"{len(missed)} conditions do not hold:{lines}"
        raise ConditionError(
            missed[0] if len(missed) == 1 else several,
            where=place,
            remedy="make it true, or give it time: wait=2 at the prompt and in "
            "programs, --wait 2 of a verb",
        )
    return told


def _of_one_instant(names: list[str], look: Look) -> list[m.VarValue]:
    """Return values that were all current at one instant.

    Raises:
        ConditionError: They change too fast for that.
    """
    if not names:
        return []
    for _ in range(_TRIES):
        values = look(names)
        if all(value.whole for value in values):
            return values
    raise ConditionError(
        "the values for the conditions could not be read at one instant",
        where=", ".join(names),
        got=f"{_TRIES} failed attempts",
        remedy="try again; name fewer variables in one job's conditions",
    )


def _numbers(value: m.VarValue) -> list[float]:
    """Return the elements; of a struct, which no condition can name, none."""
    return [] if isinstance(value.values, bytes) else list(map(float, value.values))
