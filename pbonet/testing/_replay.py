"""A log as a test: the code of a task is run again on recorded data.

`verify` runs each task separately with its recorded inputs, and stops at the first
value that differs. `_whole` runs tasks together, which read the new outputs of the
others.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from pbonet.errors import PbonetError
from pbonet.log import Log

from ._chance import sources_watched
from ._changed import note_changes
from ._inputs import Commits
from ._records import cycles_of, must_have_cycles, not_again
from ._run import Run
from ._verdict import Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.log import Table, TaskLife


class DivergedError(AssertionError):
    """The code gave something else than was recorded, or could not be run again."""


@sources_watched()
def verify(
    path: str | Path | Log,
    tasks: Sequence[str] = (),
    *,
    libraries: Sequence[str | Path] = (),
    rtol: float = 0.0,
) -> list[Verdict]:
    """Run the code of tasks again on a log, and return the verdicts.

    Args:
        path: The log, the folder of a run, or a `Log`.
        tasks: The tasks; none: all.
        libraries: Folders of modules, searched before those of the recording.
        rtol: Relative tolerance for floats; 0: identical to the bit.

    Raises:
        LogError: There is no log, or it has no cycle of a named task, or of any task.
        UnknownTaskError: The log has no such task.
        PbonetError: The module of a task that is named does not load, or does not fit
            its RMOD.
    """
    log = path if isinstance(path, Log) else Log(path)
    commits: dict[Table, Commits] = {}
    verdicts: list[Verdict] = []
    for task in tasks or log.tasks:
        verdict = Verdict(task=task)
        note_changes(verdict, log, libraries)
        for life in log.lives(task):
            cycles = cycles_of(life)
            verdict.recorded += cycles
            if life.table not in commits:
                commits[life.table] = Commits(log, life.table)
            if verdict.divergence is not None:
                continue
            try:
                _again(life, commits[life.table], libraries, verdict, rtol)
            except PbonetError as error:
                if tasks:
                    raise
                verdict.gaps.append(str(error))  # the others can be run again
        verdicts.append(verdict)
    must_have_cycles(log, verdicts, tasks)
    return verdicts


def _again(
    life: TaskLife,
    commits: Commits,
    libraries: Sequence[str | Path],
    verdict: Verdict,
    rtol: float,
) -> None:
    if why := not_again(life):
        verdict.gaps.append(why)
        return
    begun = time.perf_counter()
    run = Run(life, commits, libraries, verdict, rtol)
    verdict.loading += time.perf_counter() - begun
    run.go()


def replay(
    path: str | Path,
    task: str,
    *,
    libraries: Sequence[str | Path] = (),
    rtol: float = 0.0,
) -> Verdict:
    """Fail unless a task's code reproduces its recorded outputs.

    A log is a test in one line::

        def test_servo_of_last_week() -> None:
            replay("logs/run.mcap", "puma_pidg")

    Args:
        path: The log, or the folder of a run.
        task: The task.
        libraries: Folders of modules, searched before those of the recording.
        rtol: Relative tolerance for floats; 0: identical to the bit.

    Returns:
        The verdict.

    Raises:
        DivergedError: It gave something else, or not every cycle could be run again.
        LogError: There is no log, or the task has no cycle in it.
        UnknownTaskError: The log has no such task.
    """
    __tracebackhide__ = True  # of pytest
    (verdict,) = verify(path, [task], libraries=libraries, rtol=rtol)
    if not verdict.good:
        raise DivergedError(_failure(verdict))
    return verdict


def _failure(verdict: Verdict) -> str:
    """Return in one line what differs where, why that may be, and what to do."""
    known = [f"{verdict.cycles} of {verdict.recorded} cycles identical"]
    if verdict.divergence is not None:
        what = f"{verdict.task} differs from its log: {verdict.divergence}"
        remedy = "correct the module, or record a new log if the change is wanted"
        known += verdict.gaps
    else:
        first, *more = [*verdict.gaps, "not every cycle could be run again"]
        what = f"{verdict.task} cannot be verified: {first}"
        remedy = "remove that cause, and record a new log"
        known += more[:-1]
    details = "; ".join([*known, *map(str, (*verdict.changed, *verdict.params))])
    return f"{what} ({details}); {remedy}"
