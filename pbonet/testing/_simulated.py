"""A simulation, simulated again from the files in its log, and compared with it."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pbonet.config import parse_job, parse_sbs, parse_seq
from pbonet.errors import LogError
from pbonet.log import COLUMNS, Log, merge
from pbonet.master.configuration import Place
from pbonet.master.console import run
from pbonet.master.sim import BEGIN_NS

from ._chance import Chance, noting
from ._changed import note_changes
from ._records import alike, must_have_cycles
from ._verdict import Divergence, Replayed, Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pbonet.log import Cycles

_MOMENT = 1e-6
"""Seconds between an instant and a limit that is reached by it."""
_DEEP = "a/b/c/d"
"""A folder below which ``../`` in a job leads to folders of our own."""


def simulated(
    log: Log,
    tasks: Sequence[str],
    *,
    libraries: Sequence[str | Path],
    rtol: float,
    out: Path | None = None,
) -> Replayed:
    """Run a recorded simulation again, and compare every cycle.

    Args:
        log: What was recorded.
        tasks: The tasks to compare; none: all. All are run.
        libraries: Folders of modules, searched before those of the recording.
        rtol: Relative tolerance for floats.
        out: A log to write, with the new outputs of the tasks.

    Raises:
        LogError: A file of the simulation is not attached; a task has no cycle, or
            `out` cannot be written.
        UnknownTaskError: The log has no such task.
        PbonetError: The job cannot be simulated any more.
    """
    names = list(tasks or log.tasks)
    told = log.task_about(names[0]).libraries if names else ()
    place = Place(libraries=(*map(str, libraries), *told))
    begun, chance = time.perf_counter(), Chance()
    with tempfile.TemporaryDirectory(prefix="pbonet-") as folder, noting(chance):
        job = _unpack(log, Path(folder))
        seconds = _seconds(log)
        limit = _limit(log) if job.suffix == ".seq" else seconds
        now = _again(job, place, limit, out)
    found = Replayed(
        tasks=[_compared(log, now, task, rtol) for task in names],
        seconds=seconds,
        took=time.perf_counter() - begun,
    )
    must_have_cycles(log, found.tasks, tasks)
    for one in found.tasks:
        if one.divergence is not None and str(chance):
            one.gaps.append(f"{one.divergence}, but {chance}")
            one.divergence = None
        note_changes(one, log, libraries)
    firsts = [
        (log.arrays(one.task)["release_ns"][one.cycles], one.task)
        for one in found.tasks
        if one.divergence is not None
    ]
    found.first = min(firsts)[1] if firsts else ""
    return found


def _again(job: Path, place: Place, seconds: float | None, out: Path | None) -> Cycles:
    """Simulate a job or a sequence, and write its log where one is wanted."""
    runs = job.parent / "runs"
    record = "off" if out is None else "outputs"
    outcome = run(
        job, place, seconds=seconds, sim=True, record=record, runs=runs, quiet=True
    )
    if out is None:
        assert outcome.recording is not None  # noqa: S101 - a simulation has one
        return outcome.recording
    if not outcome.log:
        raise LogError(
            "the simulation's log cannot be written",
            where=str(runs),
            got="; ".join(outcome.faults),
            remedy="make room there, or name another folder by TMPDIR",
        )
    merge([Path(outcome.log)], out)
    return Log(out)


def _seconds(log: Log) -> float:
    """Return how much virtual time passed; for a log that was cut, its part."""
    told = float(log.about["seconds"])
    if told > 0:
        return told
    ends = [int(rows[-1]) for t in log.tasks if len(rows := log.arrays(t)[COLUMNS[0]])]
    return (max(ends, default=BEGIN_NS) - BEGIN_NS) * 1e-9


def _limit(log: Log) -> float:
    """Return when a sequence went to its safe job, or a moment after its end."""
    for event in log.events():
        if event["code"] == "STEP" and ": SAFE " in event["text"]:
            return float(event["time"] - BEGIN_NS) * 1e-9 - _MOMENT
    return _seconds(log) + _MOMENT


def _unpack(log: Log, folder: Path) -> Path:
    """Put the files of a run where they find each other; return its job or sequence."""
    jobs = [name for name in log.attached if name.endswith(".job")]
    sequences = [name for name in log.attached if name.endswith(".seq")]
    name = next(iter([*sequences, *jobs]), ".job")
    job = folder / _DEEP / name
    text = _text(log, name)
    _put(job, text)
    for other in jobs:
        _put(job.parent / other, _text(log, other))
    parsed = parse_seq(text, name) if sequences else parse_job(text, name)
    sbs = job.parent / parsed.sbs
    text = _text(log, sbs.name)
    _put(sbs, text)
    svar = sbs.parent / parse_sbs(text, sbs.name).svarfile
    _put(svar, _text(log, svar.name))
    for one in log.attached.values():
        if one.name.endswith(".rmod"):
            _put(job.parent / one.name, one.data.decode())
    return job


def _put(path: Path, text: str) -> None:
    path = Path(os.path.normpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _text(log: Log, name: str) -> str:
    """Return an attached file.

    Raises:
        LogError: It is not there.
    """
    if name not in log.attached:
        raise LogError(
            "the log does not contain the files of the simulation",
            where=str(log.path),
            expected=f"{name} among its attachments",
            got=", ".join(log.attached) or "none",
            remedy="simulate the job again, and compare with `pbonet log diff`",
        )
    return log.attached[name].data.decode()


def _compared(log: Log, now: Cycles, task: str, rtol: float) -> Verdict:
    """Return how far a task gives the same; `cycles` are those before it does not."""
    then = log.arrays(task)
    made = _then(then, now.arrays(task)) if task in now.tasks else {}
    verdict = Verdict(task=task, recorded=len(then["cycle"]))
    count = min(len(then["cycle"]), len(made.get("cycle", ())))
    firsts = [
        (row, name)
        for name in (COLUMNS[0], *log.variables(task))
        if (row := _first(then[name][:count], made[name][:count], rtol)) < count
    ]
    verdict.cycles, name = min(firsts, default=(count, ""))
    if name:
        verdict.divergence = _divergence(then, made, name, verdict.cycles, rtol)
    elif count != verdict.recorded:
        verdict.gaps.append(f"it has only {count} cycles now")
    return verdict


def _then(
    then: dict[str, NDArray[np.generic]], now: dict[str, NDArray[np.generic]]
) -> dict[str, NDArray[np.generic]]:
    """Return the cycles that were recorded, where only the last seconds were."""
    told, made = (one[COLUMNS[0]].astype(np.int64) for one in (then, now))
    there = np.isin(made, told)
    if there.sum() != len(told):  # other releases: they are compared in a row
        there = made >= (told.min() if len(told) else 0)
    return {name: values[there] for name, values in now.items()}


def _first(then: NDArray[np.generic], now: NDArray[np.generic], rtol: float) -> int:
    """Return the first row that differs; the number of rows when none does."""
    if then.shape != now.shape or then.dtype != now.dtype:
        return 0
    if not rtol and then.tobytes() == now.tobytes():
        return len(then)
    same = alike(then.reshape(-1), now.reshape(-1), rtol).reshape(then.shape)
    other = np.flatnonzero(~same.all(axis=tuple(range(1, same.ndim))))
    return int(other[0]) if len(other) else len(then)


def _divergence(
    then: dict[str, NDArray[np.generic]],
    now: dict[str, NDArray[np.generic]],
    name: str,
    row: int,
    rtol: float,
) -> Divergence:
    a, b = np.atleast_1d(then[name][row]), np.atleast_1d(now[name][row])
    cycle = int(then["cycle"][row].item())
    if a.shape != b.shape or a.dtype != b.dtype:
        reason = f"{name} is {b.dtype}{b.shape} now, recorded {a.dtype}{a.shape}"
        return Divergence(cycle=cycle, where="cycle", reason=reason)
    element = int(np.flatnonzero(~alike(a, b, rtol))[0])
    return Divergence(
        cycle=cycle,
        where="cycle",
        variable=name,
        element=element,
        recorded=a[element].item(),
        computed=b[element].item(),
    )
