"""PRE and POST: what must hold before a job is entered or left (section 3.2).

Before a change to a job, POST of the present job and PRE of the new one are checked on
values of one instant. If one does not hold, nothing is changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from pbonet.config import Condition, Place
from pbonet.errors import ConditionError, StateError
from pbonet.master.configuration import Asked, must_be_answerable, must_hold
from pbonet.xm.net import messages as m

from .argument_text import check_time

if TYPE_CHECKING:
    from collections.abc import Callable
    from threading import Event

    from pbonet.config import JobFile
    from pbonet.master.configuration import Clock

    from .subsystem_tasks import SubsystemTasks

T = TypeVar("T")

LOOK_TIME: Final = 0.02
"""Seconds between two checks whether conditions hold."""


class ConditionGate:
    """Conditions that are checked before a job is entered.

    Args:
        task_set: The subsystem's tasks.
        job: The job to come.
        leaves: Whether the one that stands is left by that.
        abandons: Whether it is given up, so that its POST is not asked.
        note: What leads to the job, for the log.
        halted: As for `in_time`; asked when the conditions hold, since a stop may have
            made them true.

    Raises:
        VerificationError: A condition cannot be answered.
    """

    def __init__(
        self,
        task_set: SubsystemTasks,
        job: JobFile,
        *,
        leaves: bool,
        abandons: bool = False,
        note: str = "",
        halted: Callable[[], bool] | None = None,
    ) -> None:
        self._task_set = task_set
        self._halted = halted or no_stop
        self._note = note
        self._job = job
        self._table = task_set.files.table.variables
        must_be_answerable(job, self._table)
        self._asked = [Asked("PRE", job.name, one) for one in job.pre]
        for stands in task_set.clients.call(
            _keeper(task_set), m.Job(), list[m.Standing]
        ):
            if leaves and (stands.name, stands.file) == (job.name, job.file):
                self._asked = []  # it was entered already, and something is done again
            elif leaves and not abandons:
                self._asked[:0] = _posts(stands)

    def must_hold(self) -> list[str]:
        """Return the conditions with their measured values.

        Raises:
            ConditionError: One does not hold.
            StateError: A stop came from elsewhere.
        """
        found = must_hold(self._asked, self._table, self._values)
        if self._halted():
            raise _stopped()
        return found

    def entered(self) -> None:
        """Record that the job is the present one, for later masters."""
        job = self._job
        posts = [(one.text, *_at(one)) for one in job.post]
        stands = m.Standing(name=job.name, file=job.file, post=posts)
        request = m.Job(told=stands, note=self._note)
        self._task_set.clients.call(_keeper(self._task_set), request, list[m.Standing])

    def _values(self, names: list[str]) -> list[m.VarValue]:
        request = m.Display(names=names)
        return self._task_set.clients.call(
            _keeper(self._task_set), request, list[m.VarValue]
        )


def _keeper(task_set: SubsystemTasks) -> str:
    return task_set.files.sbs.keeper


def _at(condition: Condition) -> tuple[int, int]:
    place = condition.place
    return (place.line, place.column) if place else (0, 0)


def _posts(stands: m.Standing) -> list[Asked]:
    return [
        Asked("POST", stands.name, Condition(text, Place(stands.file, line, column)))
        for text, line, column in stands.post
    ]


def no_stop() -> bool:
    """Tell that no stop came from elsewhere, where none can."""
    return False


def in_time(
    attempt: Callable[[], T],
    seconds: float | None,
    clock: Clock,
    stopped: Event,
    halted: Callable[[], bool] = no_stop,
) -> T:
    """Return the result of an attempt once its conditions hold.

    Nothing is held between two attempts, so other commands continue meanwhile.

    Args:
        attempt: Raises `ConditionError` while they do not.
        seconds: How long to retry; None or 0: try once.
        clock: The clock of `seconds`.
        stopped: Ends the wait.
        halted: Tells whether a stop from elsewhere has come since, which ends it, too:
            what stands still after a stop may be what a condition asks for.

    Raises:
        ConditionError: The time is over, and they still do not hold.
        StateError: A stop came in between.
    """
    check_time(seconds)
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
        if clock.wait(min(LOOK_TIME, left), stopped) or halted():
            raise _stopped()


def _stopped() -> StateError:
    return StateError(
        "a stop arrived during the wait for conditions", remedy="start it again"
    )
