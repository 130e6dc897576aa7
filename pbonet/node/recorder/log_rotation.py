"""The log files of one recording: when to begin a new one, which old ones to remove.

Records are passed as functions that write them. They are called at once, or kept for
some seconds and called when an error occurs.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import platform
import socket
import sys
import time
from collections import Counter, deque
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import pbonet
from pbonet.errors import LogError, Severity
from pbonet.log import Attached, LogWriter, RunAbout, log_name
from pbonet.node.ring import parse
from pbonet.xm.net import run_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.node.wire import rtpu_messages

    Say = Callable[[Severity, str, str], None]
    Do = Callable[[LogWriter], None]

RETRY: Final = 2.0
"""Seconds until the next attempt to make a new file after a failure."""
CHECK: Final = 1.0
"""Seconds between two checks whether the file is still there."""
SWEEP: Final = 5.0
"""Seconds between two checks of the size of all logs."""
FRESH: Final = 60.0
"""Seconds after its last change in which a file may belong to another recorder."""
AFTER: Final = 1.0
"""Seconds written after an error, if only the last seconds are kept."""
PORTION: Final = 0.02
"""Seconds in which what was kept is written, until the rings are emptied again."""
MOST_CHUNKS: Final = 1 << 15
"""Chunks of a file, which takes 0.2 kB of memory for each; at low rates, 4.5 hours."""
SHARE: Final = 4
"""Minimum number of files within the limit of all logs; old ones can be removed."""
_MB: Final = 1e6


def numpy_version() -> str:
    """Return the version of numpy that is installed, as the name of its folder has it.

    `importlib.metadata` is a sixth of what a recorder would load before its first pass.
    """
    for place in sys.path:
        for found in Path(place).glob("numpy-*.dist-info"):
            return found.stem.removeprefix("numpy-")
    from importlib import metadata  # it is packed, or a distribution's own

    return metadata.version("numpy")


class Time(NamedTuple):
    """The time base of a recording."""

    clock: Callable[[], float]
    """Returns seconds."""
    epoch_ns: int
    """Offset from its nanoseconds to those since 1970."""
    machine: str
    """The boot within which times can be compared."""
    seconds: float = 0.0
    """As in `RunAbout`."""


def real_time() -> Time:
    """Return the time base of this machine."""
    ahead = time.time_ns() - time.monotonic_ns()
    return Time(time.monotonic, ahead, run_folder.machine())


class LogFiles:
    """The files that one recorder writes.

    Args:
        wanted: The plan of the recording.
        say: Sends messages to the agent.
        enter: Writes what is known so far to a new file.
        by: The time base of the recording; None for this machine's.
    """

    def __init__(
        self,
        wanted: rtpu_messages.Recording,
        say: Say,
        enter: Do,
        by: Time | None = None,
    ) -> None:
        self.by = by or real_time()
        self._wanted = wanted
        self._say = say
        self._enter = enter
        self.writer: LogWriter | None = None
        self._goes_on = False
        """Whether nothing is missing between the last file and the next."""
        self.lost: Counter[str] = Counter(wanted.lost)
        """Records of each task that are in no file, for lack of room or time, also
        those of recorders that were lost before this one."""
        self.told = False
        """Whether a failure to make a file was reported."""
        self._retry = self._sweep = self._check = 0.0
        self._begun = 0.0
        self._wrong = 0.0
        """The time until which everything is written, after an error."""
        self._kept: deque[tuple[float, Do, str, bytes]] = deque()
        self._late = 0
        """Records that waited too long for the open file."""
        self.behind = False
        """Whether the last portion left something that is to be written."""
        self._portion = PORTION if by is None else math.inf
        if wanted.last:
            # It takes as long as a ring of large records takes to be full.
            import_module("mcap.writer")
        self._done: set[Path] = set()
        limits = wanted.limits
        most = limits.runs_mb / SHARE or limits.log_mb
        self._most = _MB * min(limits.log_mb or most, most)

    def turn(self) -> None:
        """Begin a file if it is time, end it if it is full, remove old ones."""
        now = self.by.clock()
        self._must_exist(now)
        over = self._wanted.last and now > self._wrong and not self._is_due
        if over and self.writer is not None:
            self._finish()
        elif self.writer is not None and self._is_full(now):
            self._goes_on = True
            self._finish()
        wanted = not self._wanted.last or self._is_due
        if wanted and self.writer is None and now >= self._retry:
            self._retry = now + RETRY
            self._open()
        self._write_kept(self._portion)
        if self._wanted.limits.runs_mb and now >= self._sweep:
            self._sweep = now + SWEEP
            self._let_go()

    def _must_exist(self, now: float) -> None:
        """Leave a file that was removed, or moved away; another one follows at once."""
        writer = self.writer
        if writer is None or now < self._check:
            return
        self._check = now + CHECK
        if not writer.is_there:
            text = f"{writer.path} was removed or moved, with what was recorded until "
            text += "now; another file follows"
            self._say(Severity.ERROR, "NOT_RECORDED", text)
            self._finish()

    def put(self, do: Do, task: str = "", records: bytes = b"") -> None:
        """Write something, now or when an error occurs.

        Args:
            do: Writes it.
            task: The task whose records these are.
            records: The records that are lost if it fails, as read from its ring.
        """
        if self._wanted.last:
            self._keep(do, task, records)
        elif not self.write(do):
            self._count(task, records)

    def _keep(self, do: Do, task: str, records: bytes) -> None:
        """Keep something; forget what is older than the last seconds.

        What is to be written may wait as long again.
        """
        now = self.by.clock()
        self._kept.append((now, do, task, records))
        oldest = now - self._wanted.last * (2.0 if self._is_due else 1.0)
        while self._kept[0][0] < oldest:
            due = self._is_due
            _, _, task, gone = self._kept.popleft()
            if due:
                self._late += self._count(task, gone)

    def _count(self, task: str, records: bytes) -> int:
        """Count records of a task as lost; return how many they are."""
        count = len(parse(records)) if records else 0
        if count:
            self.lost[task] += count
        return count

    @property
    def _is_due(self) -> bool:
        """Whether the oldest of what was kept is to be written."""
        return bool(self._kept) and self._kept[0][0] <= self._wrong

    def _write_kept(self, seconds: float) -> None:
        """Write what was kept, in this time or a little more."""
        end = time.monotonic() + seconds
        while self._is_due and self.writer is not None:
            _, do, task, records = self._kept.popleft()
            if not self.write(do):
                self._count(task, records)
            if time.monotonic() >= end:
                break
        self.behind = self._is_due and self.writer is not None

    def write(self, do: Do) -> bool:
        """Write something if there is a file; return whether it was written."""
        writer = self.writer
        if writer is None:
            return False
        try:
            do(writer)
        except OSError as error:
            self._full(error)
            return False
        return True

    def went_wrong(self) -> None:
        """Write what was kept, and everything in the next second.

        Only the first of some errors begins to write: the rings are emptied meanwhile.
        """
        if self._wanted.last:
            self._wrong = self.by.clock() + AFTER
            if self.writer is None:
                self.turn()

    def close(self) -> None:
        """Write what was kept and is to be written, and finish the file."""
        self._write_kept(math.inf)
        self._finish()

    def _finish(self) -> None:
        """Finish the file; at its end stands what the recording has lost so far."""
        if self.lost:
            now, lost = round(self.by.clock() * 1e9), dict(self.lost)
            status: dict[str, object] = {"tasks": {}, "lost": lost}
            self.write(lambda writer: writer.add_status(now, status))
        writer = self.writer
        if writer is not None and self.write(lambda writer: writer.close()):
            self._done.add(writer.path)
            self._retry = 0.0
            if self._late:
                text = f"{self._late} records waited too long for the disk; they are "
                text += f"not in {writer.path}"
                self._say(Severity.WARNING, "NOT_RECORDED", text)
        self.writer = None

    def _is_full(self, now: float) -> bool:
        if self.writer is None or self._wanted.last:
            return False
        seconds = 60.0 * self._wanted.limits.log_minutes
        full = bool(self._most) and self.writer.size >= self._most
        full = full or self.writer.chunks >= MOST_CHUNKS
        return full or bool(seconds and now >= self._begun + seconds)

    def _open(self) -> None:
        """Begin a file, and write to it what is known so far."""
        lost = self.lost.total()
        try:
            self.writer = self._make()
            self._enter(self.writer)
        except (OSError, LogError) as error:
            self._full(error)
            return
        self._goes_on, self._late, self._begun = False, 0, self.by.clock()
        if lost:
            text = f"{lost} records were lost before {self.writer.path}"
            self._say(Severity.WARNING, "LOG_CONTINUED", text)

    def _make(self) -> LogWriter:
        wanted = self._wanted
        folder = Path(wanted.folder)
        folder.mkdir(parents=True, exist_ok=True)
        number = 1
        while (path := folder / log_name(wanted.file, number)).exists():
            number += 1
        texts = sorted(wanted.files.items())
        attached = [Attached(name, text.encode()) for name, text in texts]
        return LogWriter(path, self._about(number), attached)

    def _about(self, part: int) -> RunAbout:
        wanted = self._wanted
        digest = hashlib.sha256()
        for name, text in sorted(wanted.files.items()):
            digest.update(f"{name}\0{len(text)}\0{text}".encode())
        return RunAbout(
            run=wanted.run,
            job=wanted.job,
            subsystem=wanted.subsystem,
            domain=wanted.domain,
            rtpu=wanted.rtpu,
            host=socket.gethostname(),
            machine=self.by.machine,
            pbonet=pbonet.__version__,
            python=platform.python_version(),
            numpy=numpy_version(),
            kernel=platform.release(),
            config_hash=digest.hexdigest(),
            begun=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            epoch_ns=self.by.epoch_ns,
            seconds=self.by.seconds,
            part=part,
            goes_on=self._goes_on,
            last=wanted.last,
        )

    def _full(self, error: OSError | LogError) -> None:
        """Continue without a file; a new one is tried at intervals."""
        writer, self.writer = self.writer, None
        self._retry = self.by.clock() + RETRY
        self._goes_on = False
        if writer is not None:
            with contextlib.suppress(OSError):
                writer.close()
        if writer is not None or not self.told:
            where = writer.path if writer is not None else self._wanted.folder
            why = error.strerror if isinstance(error, OSError) else str(error)
            self.told = True
            self._say(
                Severity.ERROR,
                "LOG_FULL",
                f"{where} cannot grow: {why}; tasks continue, their records are lost "
                f"until a new file can be made",
            )

    def _let_go(self) -> None:
        """Remove the oldest logs while all of them together exceed the limit."""
        mine = self.writer.path if self.writer is not None else None
        fresh = time.time() - FRESH
        found: list[tuple[float, int, Path]] = []
        for path in Path(self._wanted.folder).parent.glob("*/*.mcap"):
            with contextlib.suppress(OSError):
                state = path.stat()
                found.append((state.st_mtime, state.st_size, path))
        excess = sum(size for _, size, _ in found) - self._wanted.limits.runs_mb * _MB
        gone: list[Path] = []
        for changed, size, path in sorted(found):
            if excess <= 0:
                break
            if path == mine or (changed > fresh and path not in self._done):
                continue
            with contextlib.suppress(OSError):
                path.unlink()
                gone.append(path)
                excess -= size
            with contextlib.suppress(OSError):
                path.parent.rmdir()  # if it is empty now
        if gone:
            text = f"{len(gone)} of the oldest logs were removed, because all together "
            text += f"may take {self._wanted.limits.runs_mb:g} MB: {gone[0]}"
            self._say(Severity.INFO, "LOG_REMOVED", text)
