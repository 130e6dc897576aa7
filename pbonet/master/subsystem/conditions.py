"""PRE and POST: what must hold before a job is entered or left (section 3.2).

Whoever goes over to a job asks first: POST of the job that stands, PRE of the one to
come. The answer rests on values of one instant. Where it is no, nothing is changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from msgspec import Struct

from pbonet.analysis import legality
from pbonet.config.model import Condition, Place
from pbonet.errors import ConditionError, StateError
from pbonet.xm.net import messages as m

from .argument_text import check_time

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from threading import Event

    from pbonet.config.model import JobFile, Variable
    from pbonet.master.configuration.clock import Clock

    from .subsystem_tasks import Crew

    Look = Callable[[list[str]], list[m.VarValue]]

T = TypeVar("T")

LOOK_TIME: Final = 0.02
"""Seconds between two looks whether conditions hold by now."""
_TRIES: Final = 50
"""Looks at the table until its values are proven to be of one instant."""


class Asked(Struct, frozen=True):
    """One condition, and whose it is."""

    keyword: str
    job: str
    condition: Condition

    def text(self, outcome: legality.Outcome) -> str:
        """Return what came of it."""
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
    """Return what is seen of conditions that all hold.

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
            remedy="bring it about, or give it time: wait=2 at the prompt and in "
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
        "the values that conditions need are not had of one instant",
        where=", ".join(names),
        got=f"{_TRIES} looks in vain",
        remedy="try again; name fewer variables in one job's conditions",
    )


def _numbers(value: m.VarValue) -> list[float]:
    """Return the elements; of a struct, which no condition can name, none."""
    return [] if isinstance(value.values, bytes) else list(map(float, value.values))


class Gate:
    """What is asked before a job is entered.

    Args:
        crew: The subsystem.
        job: The job to come.
        leaves: Whether the one that stands is left by that.

    Raises:
        VerificationError: A condition cannot be answered.
    """

    def __init__(self, crew: Crew, job: JobFile, *, leaves: bool) -> None:
        self._crew = crew
        self._job = job
        self._table = crew.files.table.variables
        must_be_answerable(job, self._table)
        self._asked = [Asked("PRE", job.name, one) for one in job.pre]
        for stands in crew.fleet.call(_keeper(crew), m.Job(), list[m.Standing]):
            if leaves and (stands.name, stands.file) == (job.name, job.file):
                self._asked = []  # it was entered already, and something is done again
            elif leaves:
                self._asked[:0] = _posts(stands)

    def must_hold(self) -> list[str]:
        """Return what is seen of the conditions.

        Raises:
            ConditionError: One does not hold.
        """
        return must_hold(self._asked, self._table, self._look)

    def entered(self) -> None:
        """Note for whoever comes later that the job stands now."""
        job = self._job
        posts = [(one.text, *_at(one)) for one in job.post]
        stands = m.Standing(name=job.name, file=job.file, post=posts)
        self._crew.fleet.call(_keeper(self._crew), m.Job(told=stands), list[m.Standing])

    def _look(self, names: list[str]) -> list[m.VarValue]:
        request = m.Display(names=names)
        return self._crew.fleet.call(_keeper(self._crew), request, list[m.VarValue])


def _keeper(crew: Crew) -> str:
    return crew.files.sbs.keeper


def _at(condition: Condition) -> tuple[int, int]:
    place = condition.place
    return (place.line, place.column) if place else (0, 0)


def _posts(stands: m.Standing) -> list[Asked]:
    return [
        Asked("POST", stands.name, Condition(text, Place(stands.file, line, column)))
        for text, line, column in stands.post
    ]


def in_time(
    attempt: Callable[[], T], seconds: float | None, clock: Clock, stopped: Event
) -> T:
    """Return what an attempt returns, once conditions let it.

    Nothing is held between two attempts, so other commands go on meanwhile.

    Args:
        attempt: Raises `ConditionError` while they do not.
        seconds: How long to go on trying; None or 0: once.
        clock: Whose seconds.
        stopped: Ends the waiting.

    Raises:
        ConditionError: The time is over, and they still do not hold.
        StateError: A stop came in between.
    """
    check_time(seconds)
    stopped.clear()
    end = clock.now() + (seconds or 0.0)
    while True:
        try:
            return attempt()
        except ConditionError as error:
            left = end - clock.now()
            if left <= 0:
                if seconds:
                    error.expected = f"them to hold within {seconds:g} s"
                raise
        if clock.wait(min(LOOK_TIME, left), stopped):
            raise StateError(
                "a stop came while conditions were waited for",
                remedy="start it again when nobody stops it",
            )
