"""Puts a run in virtual time into a log as it goes, as a recorder does in real time."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from pbonet.config import Library
from pbonet.errors import LogError, Severity
from pbonet.log import Log
from pbonet.master.configuration import Files, RecordingPlan
from pbonet.node.recorder import LogFiles, Time, recorder_process
from pbonet.node.wire import rtpu_messages

from .virtual_rtpus import BEGIN_NS

if TYPE_CHECKING:
    from pbonet.log import LogWriter, TaskAbout
    from pbonet.master.configuration import Place
    from pbonet.xm.net import Event

    from .rtpu_in_process import VirtualTask

FLUSH: Final = 0.5
"""Seconds, of real time, of which at most a simulation that is killed lacks the end."""
UNTIL_STOPPED: Final = -1.0
"""Stands for the seconds of a simulation that has not ended, and has no end."""


class _Rtpu:
    """What is recorded of one RTPU.

    Args:
        wanted: What, and where to.
        by: The virtual time.
        faults: Takes what goes wrong with the files.
    """

    def __init__(
        self, wanted: rtpu_messages.Recording, by: Time, faults: list[str]
    ) -> None:
        self.wanted = wanted
        self._faults = faults
        self.files = LogFiles(wanted, self._say, self._enter_all, by)
        self.followed: list[recorder_process.Followed] = []
        self._status = 0.0

    def _say(self, severity: Severity, code: str, text: str) -> None:
        if severity >= Severity.WARNING:
            self._faults.append(f"{code}: {text}")

    def _enter_all(self, writer: LogWriter) -> None:
        for one in self.followed:
            recorder_process.enter(writer, one)
            one.ring.want()

    def mode(self, task: str) -> str:
        """Return how a task is recorded."""
        return self.wanted.tasks.get(task, self.wanted.mode)

    def follow(self, host: VirtualTask, about: TaskAbout) -> None:
        """Record a task from its spawn on."""
        mode = self.mode(about.task)
        if mode == "off":
            return
        if mode == "all":
            host.ring.want(always=True)
        recorder_process.hide(about, self.wanted.hidden)
        one = recorder_process.Followed(host.ring, about)
        host.drain = lambda: self._take(one)
        self.followed.append(one)
        self.files.write(lambda writer: recorder_process.enter(writer, one))

    def event(self, event: Event) -> None:
        """Put an event on record; behind an error, what was kept is written."""
        plain = msgspec.to_builtins(event)
        self.files.put(lambda writer: writer.add_event(plain))
        if event.severity >= Severity.ERROR:
            self.files.went_wrong()

    def turn(self, now_ns: int, counts: dict[str, int]) -> None:
        """Write what there is.

        Args:
            now_ns: The virtual time.
            counts: Cycles of each task since it was spawned.
        """
        self.files.turn()
        for one in self.followed:
            self._take(one)
        if now_ns * 1e-9 >= self._status:
            self._status = now_ns * 1e-9 + recorder_process.STATUS
            self.status(now_ns, counts)

    def _take(self, one: recorder_process.Followed) -> None:
        if text := one.ring.take():
            self.files.put(lambda writer: recorder_process.add(writer, one, text), text)

    def status(self, now_ns: int, counts: dict[str, int]) -> None:
        """Put the counts on record; in virtual time nothing is late and no CPU used."""
        none = dict.fromkeys(("missed", "failed", "faults", "lost"), 0)
        free = dict.fromkeys(("cpu_s", "cpu_max_s", "jitter_max_s"), 0.0)
        tasks = {
            one.about.task: {"cycles": counts.get(one.about.task, 0), **none, **free}
            for one in self.followed
        }
        self.files.put(lambda writer: writer.add_status(now_ns, {"tasks": tasks}))


class SimLog:
    """The log of one simulated run, in the place of one in real time.

    Args:
        book: How it is recorded.
        files: What it is made of.
        place: Where RMODs are found.
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
        place: Place,
        runs: str | Path | None,
        seconds: float,
    ) -> None:
        self.faults: list[str] = []
        self.epoch_ns = time.time_ns() - BEGIN_NS
        self._libraries = tuple(
            str(Path(folder).absolute()) for folder in place.libraries
        )
        self._now_ns = 0
        self._flush = 0.0
        self._hosts: dict[str, VirtualTask] = {}
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
            name: _Rtpu(
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
        self._hosts[about.task] = host
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
            rtpu.turn(now_ns, self._counts())
        if (now := time.monotonic()) >= self._flush:
            self._flush = now + FLUSH
            for rtpu in self._rtpus.values():
                rtpu.files.write(lambda writer: writer.flush())

    def _counts(self) -> dict[str, int]:
        return {name: host.cycles for name, host in self._hosts.items()}

    def end(self, now_ns: int, seconds: float) -> None:
        """Finish the files, and say in them how much virtual time has passed."""
        if not self._begun:
            return
        self.turn(now_ns)
        for rtpu in self._rtpus.values():
            rtpu.status(now_ns, self._counts())
            rtpu.files.write(lambda writer: writer.lasted(seconds))
            rtpu.files.close()

    @property
    def written(self) -> bool:
        """Whether there is a file."""
        return any(self.folder.glob("*.mcap"))

    def read(self) -> Log | None:
        """Return what was recorded; None: nothing was, or it cannot be read."""
        try:
            return Log(self.folder) if self.written else None
        except LogError as error:
            self.faults.append(str(error))
            return None


def begin(
    path: str | Path,
    place: Place,
    *,
    record: str | None,
    runs: str | Path | None,
    seconds: float,
) -> SimLog | None:
    """Return the log of a run that is about to be simulated; None: it has none.

    Args:
        path: The ``.job`` file.
        place: Where RMODs are found.
        record: ``off``, ``outputs``, ``all`` or ``last SECONDS``; None for what the job
            says.
        runs: Folder of the logs; None for PBONET_RUNS, else ``runs`` here.
        seconds: How much virtual time shall pass.

    Raises:
        LogError: There is no such way to record.
        ConfigError: The job names what is neither one of its tasks nor a variable.
    """
    book = RecordingPlan(record)
    files = Files(path, Library(place.libraries))
    book.of(files.read_job(), files)
    if not book.wanted:
        return None
    return SimLog(book, files, place, runs, seconds)
