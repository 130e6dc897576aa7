"""Runs of a job in virtual time with given rates: their errors, as a process.

The process reads a `Wish` from each line of its standard input and answers with a
`Seen`. Several of them use all cores; what one leaves that is ended is in the folder of
its shared memory, which its parent removes.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec import Struct

from pbonet.config import Condition, cost_of
from pbonet.errors import PbonetError, WireError
from pbonet.master.tools import schedule_job

from .run_error import error_of, last_before

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pbonet.config import Variable
    from pbonet.svar import Table


class Wish(Struct, frozen=True, kw_only=True):
    """A run that is wanted."""

    job: str
    rates: dict[str, float]
    """Hz of tasks, in place of those that the job has."""
    cost: str
    seconds: float
    settle: float
    """Seconds before the error counts."""
    libraries: list[str] = []
    host: str = ""
    assume: float | None = None


class Seen(Struct, frozen=True, kw_only=True):
    """The result of a run."""

    error: float | None = None
    """None: it is not a finite number."""
    missing: list[str] = []
    """Tasks that missed deadlines."""
    stopped: str = ""
    """The failure that ended a task in the run, which says nothing about rates then."""
    fault: WireError | None = None
    """Why there is no result."""


def measured(wish: Wish) -> Seen:
    """Run a job and return its error.

    Raises:
        PbonetError: It cannot be simulated.
    """
    _, parsed = cost_of(Condition(wish.cost))
    watch = _Watch(parsed.variables)
    outcome, told = schedule_job.simulate(
        wish.job,
        wish.settle + wish.seconds,
        wish.libraries,
        host=wish.host,
        assume=wish.assume,
        code=True,
        rates=wish.rates,
        watch=watch,
    )
    begin, end = wish.settle * 1e9, (wish.settle + wish.seconds) * 1e9
    error = error_of(wish.cost, watch.table, watch.values_at, begin, end)
    return Seen(
        error=error,
        missing=sorted(outcome.missing),
        stopped=_reason(outcome.stopped, told),
    )


def _reason(stopped: Sequence[str], told: Sequence[str]) -> str:
    """Return what ended the first task that was ended; empty if none was."""
    if not stopped:
        return ""
    about = f" s {stopped[0]}: "
    return next((text for text in told if about in text), f"{stopped[0]} went OFF")


class _Watch:
    """Keeps the values of variables whenever they change.

    Args:
        names: The variables.
    """

    def __init__(self, names: list[str]) -> None:
        self._times: dict[str, list[int]] = {name: [] for name in names}
        self._values: dict[str, list[NDArray[np.float64]]] = {n: [] for n in names}
        self.table: list[Variable] = []

    def __call__(self, now_ns: int, task: str, table: Table) -> None:
        """Take the values after a cycle."""
        del task
        if not self.table:
            self.table = [table.variable(name) for name in self._times]
        for name, kept in self._values.items():
            value = np.array(table.read(name), np.float64).reshape(-1)
            if not kept or not np.array_equal(value, kept[-1]):
                self._times[name].append(now_ns)
                kept.append(value)

    def values_at(self, name: str, at_ns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the value at each instant; the first one before that."""
        if not self._values[name]:
            raise _nothing_ran(name)
        return last_before(self._times[name], np.array(self._values[name]), at_ns)


def _nothing_ran(name: str) -> PbonetError:
    return PbonetError(
        "no cycle ended in the run, so there is no error",
        where=name,
        remedy="run it for longer: --seconds",
    )


def main() -> None:
    """Do the runs that standard input describes."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what modules print is no answer
    for line in sys.stdin.buffer:
        wish = msgspec.json.decode(line, type=Wish)
        try:
            seen = measured(wish)
        except PbonetError as error:
            seen = Seen(fault=error.to_wire())
        answers.write(msgspec.json.encode(seen) + b"\n")
        answers.flush()


if __name__ == "__main__":
    main()
