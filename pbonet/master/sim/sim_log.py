"""Writes the log of a run in virtual time, as a recorder does in real time."""

from __future__ import annotations

import math
import os
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pbonet.errors import LogError
from pbonet.log import Log
from pbonet.master.configuration import RecordingPlan
from pbonet.node.recorder import Recorder, Time
from pbonet.node.wire import rtpu_messages

from .virtual_loop import BEGIN_NS

if TYPE_CHECKING:
    from pbonet.log import TaskAbout
    from pbonet.master.configuration import Files
    from pbonet.xm.net import Event

    from .rtpu_in_process import VirtualTask

UNTIL_STOPPED: Final = -1.0
"""Stands for the seconds of a simulation that has not ended, and has no end."""


class _Recorder(Recorder):
    """Records one RTPU: a recorder that gets the list of rings.

    Args:
        wanted: What, and where to.
        by: The virtual time.
        faults: Takes what goes wrong with the files.
    """

    def __init__(
        self, wanted: rtpu_messages.Recording, by: Time, faults: list[str]
    ) -> None:
        def report(message: rtpu_messages.FromRecorder) -> None:
            if isinstance(message, rtpu_messages.Note):
                faults.append(f"{message.code}: {message.text}")

        super().__init__(wanted, report, by)
        self._hosts: dict[str, VirtualTask] = {}

    def follow(self, host: VirtualTask, about: TaskAbout) -> None:
        """Record a task from its spawn on."""
        mode = self._mode(about)
        if mode == "off":
            return
        host.ring.want(always=mode == "all")
        key = about.task, len(self._rings)
        self._begin(key, host.ring, about)
        host.drain, host.recorded = partial(self._take, self._rings[key]), True
        self._hosts[about.task] = host

    def last(self, seconds: float) -> None:
        """Finish the log, and record how much virtual time has passed."""
        self._files.write(lambda writer: writer.lasted(seconds))
        self.end()

    def _poll(self) -> None:
        """Do nothing: every ring is reported."""

    def _slots(self) -> dict[str, object]:
        """Return the counts; in virtual time nothing is late and no CPU used."""
        none = dict.fromkeys(("missed", "failed", "faults", "lost"), 0)
        free = dict.fromkeys(("cpu_s", "cpu_max_s", "jitter_max_s"), 0.0)
        return {
            "tasks": {
                name: {"cycles": host.cycles, **none, **free}
                for name, host in self._hosts.items()
            }
        }


class SimLog:
    """The log of one simulated run.

    Args:
        book: How it is recorded.
        files: What it is made of.
        runs: Folder of the logs; None for PBONET_RUNS, else ``runs`` here.
        seconds: How much virtual time shall pass.

    Attributes:
        folder: Of the run.
        faults: What went wrong with the files.
        epoch_ns: What is added to virtual time to get nanoseconds since 1970.
    """

    def __init__(
        self,
        book: RecordingPlan,
        files: Files,
        runs: str | Path | None,
        seconds: float,
    ) -> None:
        self.faults: list[str] = []
        self.epoch_ns = time.time_ns() - BEGIN_NS
        self._libraries = tuple(
            str(Path(folder).absolute()) for folder in files.library.folders
        )
        self._now_ns = 0
        self._begun = False
        job = book.job_name or files.sbs.subsystem
        run = book.named(job)
        root = Path(runs or os.environ.get("PBONET_RUNS", "runs")).absolute()
        self.folder = root / run
        names = [entry.name for entry in files.sbs.rtpus]
        self._by = Time(
            lambda: self._now_ns * 1e-9,
            self.epoch_ns,
            machine=f"virtual {run}",
            seconds=seconds if math.isfinite(seconds) else UNTIL_STOPPED,
        )
        texts = book.texts(files)
        self._rtpus = {
            name: _Recorder(
                rtpu_messages.Recording(
                    domain="",
                    rtpu=name,
                    subsystem=files.sbs.subsystem,
                    core=0,
                    folder=str(self.folder),
                    file="run" if len(names) == 1 else name,
                    run=run,
                    job=job,
                    mode=book.mode,
                    tasks=book.modes,
                    hidden=book.hidden,
                    files=texts,
                    last=book.last,
                ),
                self._by,
                self.faults,
            )
            for name in names
        }

    def follow(self, host: VirtualTask, about: TaskAbout) -> None:
        """Record a task that is about to be spawned."""
        about.domain = ""
        about.libraries = self._libraries
        self._rtpus[about.rtpu].follow(host, about)

    def event(self, event: Event) -> None:
        """Put an event on record."""
        self.turn(event.time)
        self._rtpus[event.rtpu].event(event)

    def turn(self, now_ns: int) -> None:
        """Write what there is, as virtual time has come to an instant."""
        self._now_ns = now_ns
        self._begun = True
        for rtpu in self._rtpus.values():
            rtpu.turn()

    def end(self, now_ns: int, seconds: float) -> None:
        """Finish the files, and record in them how much virtual time has passed."""
        if not self._begun:
            return
        self._now_ns = now_ns
        for rtpu in self._rtpus.values():
            rtpu.last(seconds)

    @property
    def written(self) -> bool:
        """Whether there is a file."""
        return any(self.folder.glob("*.mcap"))

    def read(self) -> Log | None:
        """Return the recording; None if there is none, or it cannot be read."""
        try:
            return Log(self.folder) if self.written else None
        except LogError as error:
            self.faults.append(str(error))
            return None


def begin(
    files: Files,
    *,
    record: str | None,
    runs: str | Path | None,
    seconds: float,
) -> SimLog | None:
    """Return the log of a run that is about to be simulated; None: it has none.

    Args:
        files: Those of the job or the sequence.
        record: ``off``, ``outputs``, ``all`` or ``last SECONDS``; None for what the job
            says.
        runs: Folder of the logs; None for PBONET_RUNS, else ``runs`` here.
        seconds: How much virtual time shall pass.

    Raises:
        LogError: There is no such way to record.
        ConfigError: The job names what is neither one of its tasks nor a variable.
    """
    book = RecordingPlan(record)
    book.of(files.recorded_job(), files)
    if not book.wanted:
        return None
    return SimLog(book, files, runs, seconds)
