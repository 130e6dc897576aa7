"""The master's part in recording: the run's identity and what is recorded.

Recording never is in the way of a run: what cannot be recorded is a warning.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pbonet.errors import StateError
from pbonet.master.configuration import RecordingPlan
from pbonet.xm.net import messages as m, rpc, run_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.log import Log
    from pbonet.master.configuration import Files

    from .rtpu_clients import RtpuClients

FINISH_TIME: Final = 5.0
"""Seconds that recorders may take to finish."""


class RecordingControl(RecordingPlan):
    """Has runs of a subsystem recorded, as planned.

    Args:
        mode: As for `RecordingPlan`.

    Attributes:
        paths: The log of each RTPU, on its machine, once the run has started.
    """

    def __init__(self, mode: str | None = None) -> None:
        super().__init__(mode)
        self.paths: dict[str, m.Recorded] = {}

    def begin(
        self, clients: RtpuClients, files: Files, warned: Callable[[str], None]
    ) -> None:
        """Have the agents record from now on, unless they do already."""
        if self.run:
            return
        job = self.job_name or files.sbs.subsystem
        self.named(job)
        if not self.wanted:
            return
        texts = self.texts(files)
        alone = len(clients.names) == 1

        def request(rtpu: str) -> m.Record:
            return m.Record(
                run=self.run,
                file="run" if alone else rtpu,
                job=job,
                mode=self.mode,
                tasks=self._tasks,
                hidden=self._hidden,
                files=texts,
                last=self.last,
            )

        self.paths, errors = clients.each(request, m.Recorded)
        for error in errors:
            warned(f"not recorded: {error}")

    def end(self) -> None:
        """The run has ended; the next task begins another."""
        self.run = ""

    def finish(self, clients: RtpuClients) -> Log | None:
        """Have the logs finished while tasks continue; return the run as recorded here.

        Raises:
            PbonetError: An agent did not answer, or a log cannot be read.
        """
        _, errors = clients.each(lambda _: m.Record(mode="off"), m.Recorded)
        rpc.raise_all("not every log was finished", errors)
        return self.log()

    def log(self) -> Log | None:
        """Return this machine's log, once it is complete.

        Raises:
            LogError: A log cannot be read.
        """
        deadline = time.monotonic() + FINISH_TIME
        while not all(map(self._is_done, self.here)) and time.monotonic() < deadline:
            time.sleep(0.02)
        there = [path for path in self.here if _newest(path).exists()]
        if not there:
            return None
        from pbonet.log import Log  # it is loaded with numpy

        return Log(there[0].parent)

    def _is_done(self, path: Path) -> bool:
        """Return whether a recording is written whole, or need not be there."""
        from pbonet.log import is_complete

        newest = _newest(path)
        return is_complete(newest) or bool(self.last and not newest.exists())

    @property
    def here(self) -> list[Path]:
        """The logs that are on this machine."""
        machine = run_folder.machine()
        found = [one for one in self.paths.values() if one.machine == machine]
        return [Path(one.path) for one in found if one.path]


def book(mode: str | None, *, virtual: bool) -> RecordingControl:
    """Return the logbook of a program.

    Args:
        mode: As for `RecordingControl`.
        virtual: In virtual time, where a program writes no log.

    Raises:
        LogError: There is no such mode.
        StateError: A log is asked for in virtual time.
    """
    if virtual and mode not in {None, "off"}:
        raise StateError(
            "a program in virtual time writes no log",
            expected="record=None or 'off'",
            got=repr(mode),
            remedy="every cycle is in simulation.recording; 'pbonet run --sim' writes "
            "the log of a job in virtual time",
        )
    return RecordingControl("off" if virtual else mode)


def _newest(path: Path) -> Path:
    """Return the last file of the recording that begins with this file."""
    from pbonet.log import log_name

    numbers = [
        int(number)
        for one in path.parent.glob(f"{path.stem}-*.mcap")
        if (number := one.stem.removeprefix(f"{path.stem}-")).isdecimal()
    ]
    return path.with_name(log_name(path.stem, max(numbers, default=1)))
