"""The recorder: a process of the agent that writes the records in tasks' rings.

It is not part of the real-time side. It finds the rings of its subsystem and RTPU in
shared memory, empties them every 50 ms, and writes a log; events come from the agent
through a pipe, and when the pipe is closed, the recorder finishes its log and ends.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import signal
import sys
import time
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.msgpack import Decoder

from pbonet import shm
from pbonet.errors import NodeError, PbonetError, Severity
from pbonet.log import Attached, LogWriter, TaskAbout
from pbonet.node import rt
from pbonet.node.ring import Ring
from pbonet.node.rtpu import orphaned_rings
from pbonet.node.wire import process_setup, rtpu_messages
from pbonet.xm.ipc import folder_watch
from pbonet.xm.net import Event

from .log_rotation import LogFiles, Time

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

PERIOD: Final = 0.05
"""Seconds between two passes; a ring of 1 MiB holds seconds of a 1 kHz task."""
FLUSH: Final = 0.5
"""Maximum number of seconds missing at the end of a killed recorder's log."""
STATUS: Final = 1.0
HANDOVER: Final = 3.0
"""Seconds for which a recorder of an agent that has ended may still hold a ring."""


class Followed:
    """A ring that is being emptied.

    Args:
        ring: The open ring.
        about: The task it belongs to.
    """

    def __init__(self, ring: Ring, about: TaskAbout) -> None:
        self.ring = ring
        self.about = about
        self.writer: LogWriter | None = None
        """The file in which `number` identifies the task."""
        self.number = 0
        self.lost = 0


class Recorder:
    """Records one subsystem on one RTPU.

    Args:
        wanted: The plan of the recording.
        tell: Sends messages to the agent.
        by: The time base of the recording; None for this machine's.
    """

    def __init__(
        self,
        wanted: rtpu_messages.Recording,
        tell: Callable[[rtpu_messages.FromRecorder], None],
        by: Time | None = None,
    ) -> None:
        self._wanted = wanted
        self._send = tell
        self._files = LogFiles(wanted, self._say, self._enter_all, by)
        self._rings: dict[tuple[str, int], Followed] = {}
        self._others: set[tuple[str, int]] = set()
        self._folder = str(shm.folder())
        self._waiting = False
        """Whether there are rings that may be followed later."""
        self._refused: dict[tuple[str, int], float] = {}
        self._flush = self._status = 0.0
        self._told: tuple[str, int] | None = None
        self._core: rt.CoreTable | None = None
        self._events = Decoder(Event)

    # -- rings -------------------------------------------------------------------------

    @cached_property
    def _changes(self) -> folder_watch.Changes:
        return folder_watch.Changes(self._folder)

    def turn(self) -> None:
        """Take one pass."""
        now = self._files.by.clock()
        self._files.turn()
        self._poll()
        for key, followed in list(self._rings.items()):
            try:
                self._take(followed)
            except NodeError as error:  # damaged
                self._say(Severity.ERROR, "NOT_RECORDED", str(error))
                self._others.add(key)
                self._rings.pop(key).ring.close()
        if now >= self._status:
            self._status = now + STATUS
            self._put_status()
        if (now := time.monotonic()) >= self._flush:
            self._flush = now + FLUSH
            self._files.write(lambda writer: writer.flush())
        self._report()

    @property
    def pause(self) -> float:
        """Seconds until the next pass."""
        return 0.0 if self._files.behind else PERIOD

    def end(self) -> None:
        """Write what is left, and finish the log."""
        self.turn()
        self._put_status()
        for followed in self._rings.values():
            followed.ring.close()
        self._files.close()

    def _poll(self) -> None:
        """Follow new rings, and close those that were removed."""
        if not (self._changes.changed() or self._waiting):
            return
        there = dict(self._found())
        for key in [key for key in self._rings if key not in there]:
            gone = self._rings.pop(key)
            self._take(gone)
            gone.ring.close()
        self._others &= set(there)
        for key, name in there.items():
            if key not in self._rings and key not in self._others:
                self._follow(key, name)
        self._waiting = bool(there.keys() - self._rings.keys() - self._others)

    def _found(self) -> Iterator[tuple[tuple[str, int], str]]:
        """Yield the rings that may be ours: (path, inode), and name."""
        first = shm.own("")
        ours = f"{first}{self._wanted.domain}.{self._wanted.subsystem}."
        with contextlib.suppress(FileNotFoundError):  # the folder was removed
            for entry in os.scandir(self._folder):
                name = entry.name
                if name.startswith(ours) and name.endswith(".ring"):
                    plain = name[len(first) : -len(".ring")]
                    yield (entry.path, entry.inode()), plain

    def _follow(self, key: tuple[str, int], name: str) -> None:
        try:
            ring = Ring.attach(name)
        except (NodeError, OSError, ValueError):
            return  # still empty, not ready, or gone: the next pass tries again
        try:
            about = msgspec.json.decode(ring.about, type=TaskAbout)
            mode = self._mode(about)
            if mode != "off":
                ring.want(always=mode == "all")
                self._begin(key, ring, about)
                if orphaned_rings.is_left(
                    name
                ):  # it is complete: the next pass closes it
                    Path(ring.path).unlink(missing_ok=True)
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
        """Return whether a ring's reader may be a recorder that is about to end."""
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
        hide(about, self._wanted.hidden)
        followed = self._rings[key] = Followed(ring, about)
        self._files.write(lambda writer: enter(writer, followed))
        self._record(followed, first)

    def _enter_all(self, writer: LogWriter) -> None:
        """Write what is known so far to a new file."""
        for followed in self._rings.values():
            enter(writer, followed)
            followed.ring.want()

    def _take(self, followed: Followed) -> None:
        if text := followed.ring.take():
            self._record(followed, text)
        if (lost := followed.ring.lost) > followed.lost:
            count, followed.lost = lost - followed.lost, lost
            task = followed.about.task
            if not self._wanted.last:  # else most of them would not have been written
                self._files.lost[task] += count
            text_ = f"{count} records of {task} did not fit its ring"
            self._say(Severity.WARNING, "RING_FULL", text_)

    def _record(self, followed: Followed, text: bytes) -> None:
        if text:
            task = followed.about.task
            self._files.put(lambda writer: add(writer, followed, text), task, text)

    # -- other records -----------------------------------------------------------------

    def take(self, message: rtpu_messages.ToRecorder) -> None:
        """Process a message of the agent."""
        match message:
            case rtpu_messages.Clocks():
                now, clocks = time.monotonic_ns(), msgspec.to_builtins(message)
                del clocks["type"]
                self._files.put(lambda writer: writer.add_clocks(now, clocks))
            case rtpu_messages.Commanded():
                command = msgspec.json.decode(message.data, type=dict[str, Any])
                self._files.put(lambda writer: writer.add_command(command))
            case rtpu_messages.Happened():
                self._happened(message.data)

    def _happened(self, data: bytes) -> None:
        """Process a packed event."""
        self.event(self._events.decode(data))

    def event(self, event: Event) -> None:
        """Record an event; after an error, what was kept is written.

        A task that changes its state or fails may soon be gone, and its counts with it,
        so the next pass records them.
        """
        if event.subsystem in {"", self._wanted.subsystem}:
            plain = msgspec.to_builtins(event)
            self._files.put(lambda writer: writer.add_event(plain))
            if event.code in {"STATE", "METHOD"}:
                self._status = 0.0
            if event.severity >= Severity.ERROR:
                self._files.went_wrong()

    def _put_status(self) -> None:
        now, status = round(self._files.by.clock() * 1e9), self._slots()
        self._files.put(lambda writer: writer.add_status(now, status))

    def _slots(self) -> dict[str, object]:
        """Return the counts of every task, from shared memory."""
        try:
            if self._core is None:
                self._core = rt.CoreTable(self._wanted.core, member=False)
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
                    "missed": slot.missed - slot.failed,
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
        """Report to the agent which file is written, when that has changed."""
        writer = self._files.writer
        path = str(writer.path) if writer else ""
        lost = self._files.lost.total()
        if (path, lost) != self._told:
            self._told = (path, lost)
            subsystem = self._wanted.subsystem
            self._send(
                rtpu_messages.Recorder(
                    subsystem=subsystem,
                    run=self._wanted.run,
                    path=path,
                    lost=lost,
                    handed_on=self._handed_on(),
                )
            )

    def _handed_on(self) -> dict[str, int]:
        """Return what was lost of each task, but for what rings that stand say."""
        found = self._files.lost.copy()
        if not self._wanted.last:
            for followed in self._rings.values():
                found[followed.about.task] -= followed.lost
        return dict(+found)

    def _say(self, severity: Severity, code: str, text: str) -> None:
        self._send(rtpu_messages.Note(int(severity), code, text))


def hide(about: TaskAbout, names: Iterable[str]) -> None:
    """Set which variables of a task are not recorded."""
    each = (about.inconst, about.invar, about.outconst, about.outvar)
    own = {variable.name for variables in each for variable in variables}
    about.hidden = [name for name in names if name in own]


def enter(writer: LogWriter, followed: Followed) -> None:
    """Add the channels of a task, and attach its code."""
    about = followed.about
    followed.writer, followed.number = writer, writer.add_task(about)
    rmod = Path(about.rmod_name).name
    writer.attach(Attached(rmod, about.rmod.encode()))
    for code in followed.about.code:
        with contextlib.suppress(OSError):
            data = Path(code.path).read_bytes()
            if hashlib.sha256(data).hexdigest() == code.sha256:
                writer.attach(Attached(code.path, data, "text/x-python"))


def add(writer: LogWriter, followed: Followed, text: bytes) -> None:
    """Write records read from a ring."""
    if followed.writer is not writer:  # the ring was closed when the file began
        enter(writer, followed)
    writer.add(followed.number, text)


class Pipe:
    """Messages of the agent, from a pipe that may be closed at any time.

    Args:
        fd: Its read end.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._data = bytearray()
        self.over = False
        self._decoder: Decoder[rtpu_messages.ToRecorder] = Decoder(
            rtpu_messages.ToRecorder
        )
        os.set_blocking(fd, False)

    def take(self, timeout: float) -> list[rtpu_messages.ToRecorder]:
        """Return the received messages; wait for at most `timeout` seconds."""
        if select.select([self._fd], [], [], timeout)[0]:
            with contextlib.suppress(BlockingIOError):
                part = os.read(self._fd, 1 << 20)
                self._data += part
                self.over = not part
        found: list[rtpu_messages.ToRecorder] = []
        head = rtpu_messages.LENGTH.size
        while len(self._data) >= head:
            (size,) = rtpu_messages.LENGTH.unpack_from(self._data)
            if len(self._data) < head + size:
                break
            found.append(self._decoder.decode(self._data[head : head + size]))
            del self._data[: head + size]
        return found


def main(argv: list[str]) -> int:
    """Record by the plan in a memory file (its descriptor) until stdin is closed."""
    process_setup.set_title("pbonet-recorder")
    process_setup.on_end_of_parent(os.getppid(), always=True)
    stop = False

    def asked(_number: int, _frame: object) -> None:
        nonlocal stop
        stop = True

    signal.signal(signal.SIGTERM, asked)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with os.fdopen(int(argv[0]), "rb") as file:
        file.seek(0)
        wanted = msgspec.msgpack.decode(file.read(), type=rtpu_messages.Recording)
    os.sched_setaffinity(0, process_setup.housekeeping_cores(wanted.core))
    recorder, pipe = Recorder(wanted, _send), Pipe(sys.stdin.fileno())
    recorder.turn()
    for told in wanted.before:
        recorder.take(told)
    while not stop and not pipe.over:
        recorder.turn()
        for message in pipe.take(recorder.pause):
            recorder.take(message)
    recorder.end()
    return 0


def _send(message: rtpu_messages.FromRecorder) -> None:
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), rtpu_messages.frame(message))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
