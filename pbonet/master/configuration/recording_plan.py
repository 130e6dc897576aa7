"""The plan of a recording: which tasks, the name of the run, the files in its log."""

from __future__ import annotations

import contextlib
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pbonet.config import LAST, MODES, last_seconds, load
from pbonet.errors import ConfigError, LogError, PbonetError, did_you_mean

if TYPE_CHECKING:
    from pbonet.config import JobFile

    from .subsystem_files import Files

DEFAULT: Final = "outputs"
_ODD = re.compile(r"[^A-Za-z0-9_.\-]+")


class RecordingPlan:
    """The plan for recording the next run, and the run's name.

    Args:
        mode: ``off``, ``outputs``, ``all`` or ``last SECONDS``; None for what the job
            says.

    Raises:
        LogError: There is no such mode.

    Attributes:
        mode: Of tasks that are not named.
        last: Seconds that are kept until something goes wrong; 0: all is written.
        run: The run's name; empty before it has started.
    """

    def __init__(self, mode: str | None = None) -> None:
        first, _, rest = (mode or "").partition(" ")
        self._told_last = last_seconds(rest) if first == LAST else 0.0
        if mode is not None and mode not in MODES and not self._told_last:
            raise LogError(
                "this is not a recording mode",
                expected=f"{' or '.join(MODES)} or {LAST} SECONDS",
                got=mode,
                remedy=did_you_mean(mode, MODES) or "choose one of them",
            )
        self._told = mode if mode in MODES else None
        self.last = self._told_last
        self._job: JobFile | None = None
        self.mode = self._told or DEFAULT
        self._tasks: dict[str, str] = {}
        self._hidden: list[str] = []
        self.run = ""

    def of(self, job: JobFile, files: Files) -> None:
        """Record the next run by the job's settings.

        Raises:
            ConfigError: It names something that is neither one of its tasks nor a
                variable.
        """
        self._job, self._tasks, self._hidden = job, {}, []
        tasks = {
            name
            for task in job.tasks
            for name in (task.rmod, task.fallback)
            if name is not None
        }
        variables = {variable.name for variable in files.table.variables}
        default, self.last = DEFAULT, self._told_last
        for line in job.record:
            if line.mode == LAST:
                self.last = self._told_last or last_seconds(line.names[0])
                continue
            if not line.names:
                default = line.mode
            for name in line.names:
                if name in tasks:
                    self._tasks[name] = line.mode
                elif name in variables and line.mode == "off":
                    self._hidden.append(name)
                else:
                    known = tasks | variables
                    raise ConfigError(
                        f"RECORD {line.mode} names {name}",
                        where=str(line.place or job.file),
                        expected="a task of the job"
                        if line.mode != "off"
                        else "a task of the job, or a variable",
                        got="a variable" if name in variables else "neither",
                        remedy=did_you_mean(name, known) or "correct the name",
                    )
        self.mode = self._told or default
        if self._told is not None:
            self._tasks, self.last = {}, 0.0

    @property
    def modes(self) -> dict[str, str]:
        """How tasks are recorded that are named."""
        return dict(self._tasks)

    @property
    def wanted(self) -> bool:
        """Whether anything is recorded."""
        return self.mode != "off" or bool(set(self._tasks.values()) - {"off"})

    @property
    def job_name(self) -> str:
        """The name of the job; empty without one."""
        return self._job.name if self._job is not None else ""

    @property
    def hidden(self) -> list[str]:
        """Variables that are not recorded."""
        return list(self._hidden)

    def named(self, job: str) -> str:
        """Give the run that begins now a name, and return it."""
        now = time.time()
        stamp = time.strftime("%Y-%m-%dT%H-%M-%S", time.localtime(now))
        self.run = f"{stamp}.{int(now * 1000) % 1000:03d}-{_ODD.sub('_', job)}"
        return self.run

    def texts(self, files: Files) -> dict[str, str]:
        """Return the configuration files, by name."""
        found = {Path(files.table.file).name: files.table_text}
        paths = [str(files.path)]
        if self._job is not None:
            paths.append(self._job.file)
        if files.seq is not None:
            paths += map(str, files.step_jobs().values())
        for path in paths:
            try:
                found[Path(path).name] = load(path)
            except PbonetError:
                continue  # it was read when the subsystem was opened
        return found | self._rmods(files)

    def _rmods(self, files: Files) -> dict[str, str]:
        """Return the RMODs of the job's tasks, by the names under which logs have them.

        Of one that cannot be read its task says so when it is spawned.
        """
        tasks = self._job.tasks if self._job is not None else ()
        names: dict[str, float | None]
        names = {one.fallback: None for one in tasks if one.fallback}
        names |= {one.rmod: one.freq for one in tasks}
        found: dict[str, str] = {}
        for name, freq in sorted(names.items()):
            with contextlib.suppress(PbonetError):
                found[f"{name}.rmod"] = files.rmod(name, freq).text
        return found
