"""A job that is edited, run in virtual time by another process."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct, structs

from pbonet.config import write_job
from pbonet.errors import ConfigError, PbonetError, WireError
from pbonet.log import Log
from pbonet.xm.net import convert

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from .draft_files import DraftFiles

MOST_POINTS = 2000
"""Number of values of one variable that are returned, evenly spread over the run."""
CANCELLED: Final = "it was cancelled"


class SimulatedRun(Struct, frozen=True, kw_only=True):
    """The result of a run in virtual time."""

    ok: bool
    problems: list[str]
    """Errors and faults, in words."""
    output: str
    """The last lines that the run printed."""
    tasks: list[dict[str, Any]] = []
    """Cycles, misses, errors and the last state of each task."""
    series: dict[str, dict[str, list[Any]]] = {}
    """By variable: ``t`` in seconds, and ``v``, the elements at that time."""


class DraftSimulation:
    """A draft's job that is to be run in virtual time: a copy of its files.

    The files of the job's folders are there by links, and those that differ by copies.
    So the draft can be changed while it runs, which may be in another thread.

    Args:
        files: The files, with the draft's texts.
        seconds: How much virtual time passes.
        conditions: Whether PRE and POST are judged.
        libraries: Folders of modules.

    Raises:
        ConfigError: The job has no task, or the time is none.
    """

    def __init__(
        self,
        files: DraftFiles,
        seconds: float,
        *,
        conditions: bool = True,
        libraries: Iterable[str | Path] = (),
    ) -> None:
        if not files.draft.job.tasks:
            raise ConfigError(
                "the job has no task to simulate",
                where=files.draft.job.file,
                remedy="add one from the library",
            )
        if not 0.0 < seconds < math.inf:
            raise ConfigError(
                "the time to simulate is not above 0",
                got=f"{seconds} s",
                expected="seconds of virtual time",
                remedy="say how long",
            )
        self._folder = tempfile.TemporaryDirectory(prefix="pbonet-edit-")
        self._root, self._runs = (
            Path(self._folder.name) / one for one in ("files", "runs")
        )
        self._real = _copy(files, self._root)
        job = self._root / files.job_path.absolute().relative_to(self._real)
        if not conditions:
            bare = structs.replace(files.draft.job, pre=(), post=())
            job.write_bytes(write_job(bare).encode())
        words = ["run", str(job), "--sim", "--seconds", repr(seconds)]
        words += ["--record", "all", "--runs", str(self._runs), "--json"]
        for one in libraries:
            words += ["--library", str(one)]
        self._command = [sys.executable, "-P", "-m", "pbonet.cli", *words]
        self._guard = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._cancelled = False

    def run(self, variables: Sequence[str], *, limit: float) -> SimulatedRun:
        """Run it in another process, once, and remove the copy.

        Args:
            variables: Those whose values are returned.
            limit: Seconds that the process may take; then it is ended.
        """
        with self._folder:
            text, done = self._carry_out(limit)
            if done is None:
                return SimulatedRun(ok=False, problems=[text], output="")
            return _outcome(done, self._runs, variables)

    def cancel(self) -> None:
        """End it, from another thread; `run` returns at once."""
        with self._guard:
            self._cancelled = True
            if self._process is not None:
                self._process.kill()

    def _was_cancelled(self) -> bool:
        return self._cancelled

    def _carry_out(
        self, limit: float
    ) -> tuple[str, subprocess.CompletedProcess[str] | None]:
        """Run the process; return what it printed, or why there is nothing."""
        with self._guard:
            if self._was_cancelled():
                return CANCELLED, None
            self._process = process = subprocess.Popen(
                self._command,
                env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
            )
        try:
            out, err = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return f"it took longer than {limit:g} s and was ended", None
        if self._was_cancelled():
            return CANCELLED, None
        root, real = str(self._root), str(self._real)
        texts = (one.replace(root, real) for one in (out, err))
        status = process.returncode
        return "", subprocess.CompletedProcess(self._command, status, *texts)


def _outcome(
    done: subprocess.CompletedProcess[str], runs: Path, variables: Sequence[str]
) -> SimulatedRun:
    outcome = _json(done.stdout)
    problems = [str(text) for text in outcome.get("faults", [])]
    problems += [
        f"{task['task']}: {task['error']}"
        for task in outcome.get("tasks", [])
        if task.get("error")
    ]
    if done.returncode and not problems:
        problems.append(_said(outcome) or done.stderr.strip() or "the run failed")
    series, lacking = _series(runs, variables)
    return SimulatedRun(
        ok=done.returncode == 0,
        problems=[*problems, *lacking],
        output=done.stderr[-4000:],
        tasks=outcome.get("tasks", []),
        series=series,
    )


def _json(text: str) -> dict[str, Any]:
    """Return what the run said about itself; nothing if it said nothing."""
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.DecodeError:
        return {}


def _said(outcome: Mapping[str, Any]) -> str:
    """Return the error that a run ended with; empty: none."""
    if "error" not in outcome:
        return ""
    return str(PbonetError.from_wire(convert(outcome["error"], WireError)))


def _series(
    runs: Path, variables: Sequence[str]
) -> tuple[dict[str, dict[str, list[Any]]], list[str]]:
    """Return the values of variables, and what is wrong with some."""
    logs = sorted(runs.iterdir()) if runs.is_dir() else []
    if not logs or not variables:
        return {}, []
    found: dict[str, dict[str, list[Any]]] = {}
    problems: list[str] = []
    log = Log(logs[-1])
    for name in variables:
        try:
            times, values = log.series(name)
        except PbonetError as error:
            problems.append(str(error))
            continue
        every = max(1, math.ceil(len(times) / MOST_POINTS))
        rows = values[::every].reshape(len(times[::every]), -1).tolist()
        found[name] = {
            "t": times[::every].tolist(),
            "v": [[_finite(one) for one in row] for row in rows],
        }
    return found, problems


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _copy(files: DraftFiles, folder: Path) -> Path:
    """Make the folders of a job again, with the draft's files.

    Returns:
        The folder that `folder` stands for.
    """
    texts = {path.absolute(): text for path, text in files.draft.texts.items()}
    paths = [files.job_path, files.path, files.svar_path, *texts]
    own = {path.absolute().parent for path in paths}
    above = {one for place in own for one in (place, *place.parents)}
    made = {path.absolute() for path in files.disk.made()}
    root = Path(os.path.commonpath([*map(str, own)]))
    for place in sorted(own):  # a folder before those in it
        new = folder / place.relative_to(root)
        new.mkdir(parents=True, exist_ok=True)
        for entry in place.iterdir():
            gone = entry in texts or entry in above or entry in made
            if not gone:
                (new / entry.name).symlink_to(entry)
    for path, text in texts.items():
        (folder / path.relative_to(root)).write_bytes(text.encode())
    return root
