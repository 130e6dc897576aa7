"""The recorder: a process of the agent that writes what tasks leave in their rings.

Nothing of real time depends on it. It finds the rings of its subsystem and RTPU in
shared memory, empties them every 50 ms, and writes a log; events come from the agent
through a pipe, and when that ends, so does the recorder, its log finished.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import select
import signal
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

import pbonet
from pbonet.errors import LogError, NodeError, PbonetError, Severity
from pbonet.log import Attached, LogWriter, RunAbout, TaskAbout
from pbonet.xm import rundir
from pbonet.xm.messages import Event

from . import _rt, runtime, wire
from ._ring import Ring, parse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PERIOD: Final = 0.05
"""Seconds between two looks; a ring of 1 MiB holds seconds of a 1 kHz task."""
FLUSH: Final = 0.5
"""Seconds of which at most a killed recorder's log lacks the end."""
STATUS: Final = 1.0
HANDOVER: Final = 3.0
"""Seconds for which another recorder, whose agent is gone, may hold a ring."""
RETRY: Final = 2.0
"""Seconds until a new file is tried when one could not grow."""


class Followed:
    """A ring that is being emptied.

    Args:
        ring: Open.
        about: Whose it is.
    """

    def __init__(self, ring: Ring, about: TaskAbout) -> None:
        self.ring = ring
        self.about = about
        self.number = 0
        self.lost = 0


class Recorder:
    """Records one subsystem on one RTPU.

    Args:
        wanted: What.
        tell: Takes what the agent should know.
    """

    def __init__(
        self,
        wanted: wire.Recording,
        tell: Callable[[wire.FromRecorder], None],
    ) -> None:
        self._wanted = wanted
        self._tell = tell
        self._writer: LogWriter | None = None
        self._part = 0
        self._rings: dict[tuple[str, int], Followed] = {}
        self._others: set[tuple[str, int]] = set()
        self._refused: dict[tuple[str, int], float] = {}
        self._unwritten = 0
        self._unfit = 0
        self._retry = self._flush = self._status = 0.0
        self._told: tuple[str, int] | None = None
        self._core: _rt.CoreTable | None = None
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._events = msgspec.msgpack.Decoder(Event)

    # -- rings -------------------------------------------------------------------------

    def turn(self) -> None:
        """Do what there is to do."""
        now = time.monotonic()
        if self._writer is None and now >= self._retry:
            self._retry = now + RETRY
            self._open()
        self._look()
        for key, followed in list(self._rings.items()):
            try:
                self._take(followed)
            except NodeError as error:  # damaged
                self._say(Severity.ERROR, "NOT_RECORDED", str(error))
                self._others.add(key)
                self._rings.pop(key).ring.close()
        if now >= self._status:
            self._status = now + STATUS
            self._write(self._write_status)
        if now >= self._flush:
            self._flush = now + FLUSH
            self._write(lambda writer: writer.flush())
        self._report()

    def end(self) -> None:
        """Take what is left, and finish the log."""
        self.turn()
        self._write(self._write_status)
        for followed in self._rings.values():
            followed.ring.close()
        self._write(lambda writer: writer.close())
        self._writer = None

    def _look(self) -> None:
        """Follow rings that are new, and let go of those that were removed."""
        there = dict(self._found())
        for key in [key for key in self._rings if key not in there]:
            gone = self._rings.pop(key)
            self._take(gone)
            gone.ring.close()
        self._others &= set(there)
        for key, name in there.items():
            if key not in self._rings and key not in self._others:
                self._follow(key, name)

    def _found(self) -> Iterator[tuple[tuple[str, int], str]]:
        """Yield the rings that may be ours: path and inode, and name."""
        folder = os.environ.get("PBONET_SHM_DIR") or "/dev/shm"  # noqa: S108
        first = f"pbonet.{os.geteuid()}."
        ours = f"{first}{self._wanted.domain}.{self._wanted.subsystem}."
        with os.scandir(folder) as entries:
            for entry in entries:
                name = entry.name
                if name.startswith(ours) and name.endswith(".ring"):
                    plain = name[len(first) : -len(".ring")]
                    yield (entry.path, entry.inode()), plain

    def _follow(self, key: tuple[str, int], name: str) -> None:
        try:
            ring = Ring.attach(name)
        except (NodeError, OSError):
            return  # not ready, or gone already: the next look will see
        try:
            about = msgspec.json.decode(ring.about, type=TaskAbout)
            mode = self._mode(about)
            if mode != "off":
                ring.want(always=mode == "all")
                self._begin(key, ring, about)
                return
        except msgspec.MsgspecError:
            pass
        except NodeError as error:
            if self._waits(key):
                ring.close()
                return
            self._say(Severity.WARNING, "NOT_RECORDED", f"{name}: {error}")
        self._others.add(key)
        ring.close()

    def _waits(self, key: tuple[str, int]) -> bool:
        """Tell whether whoever drains a ring may be a recorder that is about to end."""
        now = time.monotonic()
        return now < self._refused.setdefault(key, now) + HANDOVER

    def _mode(self, about: TaskAbout) -> str:
        """Return how a task is recorded; ``off`` for one that is not ours."""
        wanted = self._wanted
        if (about.subsystem, about.rtpu) != (wanted.subsystem, wanted.rtpu):
            return "off"
        return wanted.tasks.get(about.task, wanted.mode)

    def _begin(self, key: tuple[str, int], ring: Ring, about: TaskAbout) -> None:
        first = ring.take()
        names = {variable.name for variable in about.outvar}
        about.hidden = [name for name in self._wanted.hidden if name in names]
        followed = self._rings[key] = Followed(ring, about)
        self._write(lambda writer: self._enter(writer, followed))
        self._record(followed, first)

    @staticmethod
    def _enter(writer: LogWriter, followed: Followed) -> None:
        """Make the channels of a task, and attach its code."""
        about = followed.about
        followed.number = writer.add_task(about)
        rmod = Path(about.rmod_name).name
        writer.attach(Attached(rmod, about.rmod.encode()))
        for code in followed.about.code:
            with contextlib.suppress(OSError):
                data = Path(code.path).read_bytes()
                if hashlib.sha256(data).hexdigest() == code.sha256:
                    writer.attach(Attached(code.path, data, "text/x-python"))

    def _take(self, followed: Followed) -> None:
        if text := followed.ring.take():
            self._record(followed, text)
        if (lost := followed.ring.lost) > followed.lost:
            count, followed.lost = lost - followed.lost, lost
            self._unfit += count
            task = followed.about.task
            text_ = f"{count} records of {task} did not fit its ring"
            self._say(Severity.WARNING, "RING_FULL", text_)

    def _record(self, followed: Followed, text: bytes) -> None:
        writer = self._writer
        try:
            if writer is not None:
                writer.add(followed.number, text)
                return
        except OSError as error:
            self._full(error)
        self._unwritten += len(parse(text))

    # -- the file ----------------------------------------------------------------------

    def _open(self) -> None:
        """Begin a file, and say in it what is known so far."""
        self._part += 1
        try:
            self._writer = self._make()
            for followed in self._rings.values():
                self._enter(self._writer, followed)
                followed.ring.want()
        except (OSError, LogError) as error:
            self._part -= 1
            self._full(error)
            return
        if self._unwritten:
            text = f"{self._unwritten} records were lost before {self._writer.path}"
            self._say(Severity.WARNING, "LOG_AGAIN", text)

    def _make(self) -> LogWriter:
        wanted = self._wanted
        folder = Path(wanted.folder)
        folder.mkdir(parents=True, exist_ok=True)
        number = 1
        while (path := folder / _numbered(wanted.file, number)).exists():
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
            machine=rundir.machine(),
            pbonet=pbonet.__version__,
            python=platform.python_version(),
            numpy=np.__version__,
            kernel=platform.release(),
            config_hash=digest.hexdigest(),
            begun=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            epoch_ns=self._epoch_ns,
            part=part,
        )

    def _write(self, do: Callable[[LogWriter], None]) -> None:
        writer = self._writer
        if writer is None:
            return
        try:
            do(writer)
        except OSError as error:
            self._full(error)

    def _full(self, error: OSError | LogError) -> None:
        """Go on without a file; another one is tried from time to time."""
        writer, self._writer = self._writer, None
        self._retry = time.monotonic() + RETRY
        if writer is not None:
            with contextlib.suppress(OSError):
                writer.close()
        if writer is not None or self._told is None:
            where = writer.path if writer is not None else self._wanted.folder
            why = error.strerror if isinstance(error, OSError) else str(error)
            self._say(
                Severity.ERROR,
                "LOG_FULL",
                f"{where} cannot grow: {why}; tasks go on, their records are lost "
                f"until a new file can be made",
            )

    # -- what else is written ----------------------------------------------------------

    def happened(self, data: bytes) -> None:
        """Take a packed event."""
        event = self._events.decode(data)
        if event.subsystem in {"", self._wanted.subsystem}:
            plain = msgspec.to_builtins(event)
            self._write(lambda writer: writer.add_event(plain))

    def _write_status(self, writer: LogWriter) -> None:
        writer.add_status(time.monotonic_ns(), self._slots())

    def _slots(self) -> dict[str, object]:
        """Return the counts of every task, from shared memory."""
        try:
            if self._core is None:
                self._core = _rt.CoreTable(self._wanted.core, member=False)
            owner = f"{self._wanted.domain}/{self._wanted.rtpu}"
            found = [self._core.snapshot(i) for i in self._core.slots(owner)]
        except (PbonetError, OSError):
            return {"tasks": {}}
        names = {followed.about.task for followed in self._rings.values()}
        prefix = f"{self._wanted.subsystem}/"
        return {
            "tasks": {
                name: {
                    "cycles": slot.cycles,
                    "missed": slot.missed,
                    "failed": slot.failed,
                    "cpu_s": slot.cpu_total_ns * 1e-9,
                    "cpu_max_s": slot.cpu_max_ns * 1e-9,
                    "jitter_max_s": slot.jitter_max_ns * 1e-9,
                    "faults": slot.faults,
                    "lost": slot.ring_lost,
                }
                for slot in found
                if (name := slot.task.removeprefix(prefix)) in names
            }
        }

    def _report(self) -> None:
        """Tell the agent which file is written, when that has changed."""
        path = str(self._writer.path) if self._writer else ""
        lost = self._unwritten + self._unfit
        if (path, lost) != self._told:
            self._told = (path, lost)
            subsystem = self._wanted.subsystem
            self._tell(wire.Recorder(subsystem=subsystem, path=path, lost=lost))

    def _say(self, severity: Severity, code: str, text: str) -> None:
        self._tell(wire.Note(int(severity), code, text))


def _numbered(file: str, number: int) -> str:
    return f"{file}.mcap" if number == 1 else f"{file}-{number}.mcap"


class Pipe:
    """Events from a pipe that may end at any time.

    Args:
        fd: Its end for reading.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._data = bytearray()
        self.over = False
        self._decoder = msgspec.msgpack.Decoder(wire.Happened)
        os.set_blocking(fd, False)

    def take(self, timeout: float) -> list[bytes]:
        """Return what has come; wait for at most `timeout` seconds."""
        if select.select([self._fd], [], [], timeout)[0]:
            with contextlib.suppress(BlockingIOError):
                part = os.read(self._fd, 1 << 20)
                self._data += part
                self.over = not part
        found: list[bytes] = []
        head = wire.LENGTH.size
        while len(self._data) >= head:
            (size,) = wire.LENGTH.unpack_from(self._data)
            if len(self._data) < head + size:
                break
            found.append(self._decoder.decode(self._data[head : head + size]).data)
            del self._data[: head + size]
        return found


def main(argv: list[str]) -> int:
    """Record what the memory file of that number says, while standard input is open."""
    runtime.set_title("pbonet-recorder")
    stop = False

    def asked(_number: int, _frame: object) -> None:
        nonlocal stop
        stop = True

    signal.signal(signal.SIGTERM, asked)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with os.fdopen(int(argv[0]), "rb") as file:
        file.seek(0)
        wanted = msgspec.msgpack.decode(file.read(), type=wire.Recording)
    os.sched_setaffinity(0, runtime.housekeeping_cores(wanted.core))
    recorder, pipe = Recorder(wanted, _tell), Pipe(sys.stdin.fileno())
    while not stop and not pipe.over:
        recorder.turn()
        for event in pipe.take(PERIOD):
            recorder.happened(event)
    recorder.end()
    return 0


def _tell(message: wire.FromRecorder) -> None:
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), wire.frame(message))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
