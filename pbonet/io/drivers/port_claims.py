"""Claims on the ports of a device: each port has one user on its machine.

A file per physical device is locked at one byte for each port. The kernel drops such a
lock with the process that holds it, so a task that was killed has no ports any more.
The file also says who has a port, for `pbonet devices`.

A task that was refused a port, because another task has it, or that lost its device
or could not open it, waits for the port while it lives: it has a second lock, of a
mark. Who has the port sees the mark when it is no longer ON, and gives the port up.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import struct
import time
import weakref
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakKeyDictionary

from pbonet.errors import DeviceError, DeviceTakenError
from pbonet.outside import open_devices
from pbonet.xm.net import run_folder

from . import database
from .modes import Mode

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from pbonet.config import Entry

    from .modes import Opening

_FLOCK = struct.Struct("hhqqi4x")
_RECORD = struct.Struct("<Ii56s")
"""Mode, process, and RTPU/TASK of a port's user."""
_RECORDS_AT = 1 << 20
"""Where the records begin: beyond every port's byte, and every mark."""
_FAULT = struct.Struct("<Q56s448s")
"""When it was, in nanoseconds of the clock that no one sets; RTPU/TASK; the text."""
_FAULT_AT = 1 << 19
"""Where the last error of the device is."""
_MARKS_AT = 1 << 18
"""Where the marks of tasks that wait for a port begin, one byte for each port."""
APART: Final[Mapping[str, Any]] = {"unit": 1, "table": "holding"}
"""Settings of drivers that tell devices at one address apart, and their defaults."""
MOST_PORTS = 1 << 16
"""Greatest number of ports of a physical device."""
SAFE_TIME: Final = 10.0
"""Seconds in which a guard has made the devices of a process that has ended safe."""
_MARGIN: Final = 1.0
"""Seconds that a port is waited for beyond that."""
_AGAIN: Final = 0.005
"""Seconds between two attempts to claim."""
_EXITING: Final = 0x4
"""The flag of a process that ends or has ended, in the ninth field of its ``stat``."""


class User(NamedTuple):
    """The user of a port."""

    port: int
    """Of the logical device."""
    owner: str
    """RTPU/TASK, or empty for a program."""
    mode: Mode
    pid: int


class Fault(NamedTuple):
    """The last error of a physical device."""

    text: str
    owner: str
    """RTPU/TASK, or empty for a program."""
    age: float
    """Seconds since then."""


class Claim:
    """The ports of one opening; they are given back by `release`.

    Args:
        fd: The locked file.
    """

    def __init__(self, fd: int) -> None:
        self.fd, self._owner = fd, os.getpid()

    def release(self) -> None:
        """Give the ports back, also where another process has the descriptor.

        A copy made by fork gives up only its own part in them.
        """
        fd, self.fd = self.fd, -1
        if fd >= 0:
            none = _FLOCK.pack(fcntl.F_UNLCK, os.SEEK_SET, 0, 0, 0)
            with suppress(OSError):
                if self._owner == os.getpid():
                    fcntl.fcntl(fd, fcntl.F_OFD_SETLK, none)
            os.close(fd)

    def hold(self, entry: Entry, opening: Opening) -> None:
        """Lock the ports; harmless where this claim has them.

        Raises:
            BlockingIOError: Another claim has one of them.
        """
        lock = _lock(fcntl.F_WRLCK, entry, opening)
        fcntl.fcntl(self.fd, fcntl.F_OFD_SETLK, lock)

    def note(self, text: str, owner: str) -> None:
        """Write down an error of the device, for `pbonet devices`.

        Args:
            text: The error.
            owner: The task that had the device, as `database.owner` has it.
        """
        record = _FAULT.pack(
            time.monotonic_ns(), owner.encode()[:56], text.encode()[:448]
        )
        with suppress(OSError):
            os.pwrite(self.fd, record, _FAULT_AT)

    def is_wanted(self, entry: Entry, opening: Opening) -> bool:
        """Return whether a task waits for one of the ports."""
        asked = _lock(fcntl.F_WRLCK, entry, opening, _MARKS_AT)
        kind, *_ = _FLOCK.unpack(fcntl.fcntl(self.fd, fcntl.F_OFD_GETLK, asked))
        return bool(kind != fcntl.F_UNLCK)


def _lock(kind: int, entry: Entry, opening: Opening, begin: int = 0) -> bytes:
    """Return a lock of an opening's ports, or of their marks."""
    count = opening.end - opening.start + 1
    first = begin + entry.first + opening.start
    return _FLOCK.pack(kind, os.SEEK_SET, first, count, 0)


_Ports = tuple[Path, int, int]
_marks: Final[WeakKeyDictionary[open_devices.Openings, dict[_Ports, Claim]]] = (
    WeakKeyDictionary()
)
"""The marks of this process, by task (a bench may have several in one), and ports."""


def _of_this_task() -> dict[_Ports, Claim]:
    """Return the marks of the present task; they are dropped with it."""
    task = open_devices.current()
    mine = _marks.get(task)
    if mine is None:
        mine = _marks[task] = {}
        weakref.finalize(task, _drop, mine)
    return mine


def _drop(marks: dict[_Ports, Claim]) -> None:
    for one in marks.values():
        one.release()


def _ports(entry: Entry, opening: Opening) -> _Ports:
    return _path(entry), entry.first + opening.start, entry.first + opening.end


def mark(entry: Entry, opening: Opening) -> None:
    """Say that this task waits for ports; harmless where it has said so.

    A program waits for none: it is not turned on when it has its turn.
    """
    ports, mine = _ports(entry, opening), _of_this_task()
    if database.owner() and ports not in mine:
        made = Claim(_open(_path(entry)))
        lock = _lock(fcntl.F_RDLCK, entry, opening, _MARKS_AT)
        fcntl.fcntl(made.fd, fcntl.F_OFD_SETLK, lock)
        mine[ports] = made


def _unmark(entry: Entry, opening: Opening) -> None:
    """Say that this task has the ports; harmless where it did not wait for them."""
    if made := _of_this_task().pop(_ports(entry, opening), None):
        made.release()


def claim(entry: Entry, opening: Opening) -> Claim:
    """Claim the ports of an opening for this process.

    Ports of a process that has ended are waited for: its guard makes the device safe.

    Raises:
        DeviceTakenError: Another task has one of them, and this one waits for it.
        DeviceError: One of them is taken; the error names its user.
    """
    last = entry.first + opening.end
    if last >= MOST_PORTS:
        raise _no_such(opening, last)
    deadline = time.monotonic() + SAFE_TIME + _MARGIN
    while True:
        try:
            made = _claimed(entry, opening)
        except BlockingIOError:
            who = list(users(entry, range(opening.start, opening.end + 1)))
            if not all(map(_has_ended, who)) or time.monotonic() > deadline:
                raise _refused(entry, opening, who) from None
        except OSError as error:
            raise _unusable(opening, error) from None
        else:
            _unmark(entry, opening)
            return made
        time.sleep(_AGAIN)


def _claimed(entry: Entry, opening: Opening) -> Claim:
    """Claim the ports and write down whose they are.

    Raises:
        BlockingIOError: One of them is taken.
        OSError: The file cannot be used.
    """
    made = Claim(_open(_path(entry)))
    try:
        made.hold(entry, opening)
        text = database.owner().encode()[:56]
        record = _RECORD.pack(opening.mode.value, os.getpid(), text)
        for port in range(entry.first + opening.start, entry.first + opening.end + 1):
            os.pwrite(made.fd, record, _RECORDS_AT + port * _RECORD.size)
    except BaseException:
        os.close(made.fd)
        raise
    return made


def _has_ended(user: User) -> bool:
    """Return whether the process has ended, or is ending and still has its locks."""
    try:
        stat = Path(f"/proc/{user.pid}/stat").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return not _is_there(user.pid)
    after_name = stat.rpartition(b")")[2].split()
    return bool(int(after_name[6]) & _EXITING)


def _is_there(pid: int) -> bool:
    """Return whether there is a process, which ``/proc`` may hide (hidepid)."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _open(path: Path) -> int:
    """Open a device's file, and keep it from being removed until it is closed."""
    while True:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_SH)  # what removes it holds it for an instant
            if os.path.samestat(os.fstat(fd), path.stat()):
                return fd
        except FileNotFoundError:
            pass  # it was removed just now
        except BaseException:
            os.close(fd)
            raise
        os.close(fd)


def users(entry: Entry, ports: range) -> Iterator[User]:
    """Yield the users of those ports of a logical device that are taken."""
    try:
        fd = os.open(_path(entry), os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return  # no port was ever claimed
    try:
        begin = entry.first + ports.start
        for at in _locked(fd, begin, begin + len(ports)):
            data = os.pread(fd, _RECORD.size, _RECORDS_AT + at * _RECORD.size)
            with suppress(struct.error, ValueError):
                mode, pid, text = _RECORD.unpack(data)
                owner = text.rstrip(b"\0").decode(errors="replace")
                yield User(at - entry.first, owner, Mode(mode), pid)
    finally:
        os.close(fd)


def fault(entry: Entry) -> Fault | None:
    """Return the last error of a physical device, if it has had one."""
    try:
        fd = os.open(_path(entry), os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None  # no port was ever claimed
    try:
        at_ns, owner, text = _FAULT.unpack(os.pread(fd, _FAULT.size, _FAULT_AT))
    except (OSError, struct.error):
        return None
    finally:
        os.close(fd)
    if not at_ns:
        return None
    said, who = (one.rstrip(b"\0").decode(errors="replace") for one in (text, owner))
    return Fault(said, who, (time.monotonic_ns() - at_ns) * 1e-9)


def _locked(fd: int, begin: int, end: int) -> Iterator[int]:
    """Yield the locked bytes in a range, in order."""
    if begin >= end:
        return
    asked = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, begin, end - begin, 0)
    kind, _, start, length, _ = _FLOCK.unpack(fcntl.fcntl(fd, fcntl.F_OFD_GETLK, asked))
    if kind == fcntl.F_UNLCK:
        return
    first, last = max(start, begin), min(start + length, end)
    yield from _locked(fd, begin, first)  # it named any of them, not the first one
    yield from range(first, last)
    yield from _locked(fd, last, end)


def _path(entry: Entry) -> Path:
    """Return the file of a physical device."""
    address = entry.address
    if "/" in address:  # a file, and no HOST:PORT
        address = os.path.realpath(address)
    apart = [entry.settings.get(key, usual) for key, usual in APART.items()]
    name = f"{entry.driver} {address} {apart}"
    return run_folder.claims() / hashlib.sha256(name.encode()).hexdigest()[:32]


def _refused(entry: Entry, opening: Opening, who: list[User]) -> DeviceError:
    """Return the error for ports that are taken; among tasks, wait for them."""
    are_tasks = bool(database.owner()) and all(one.owner for one in who)
    if are_tasks:
        mark(entry, opening)
    return (DeviceTakenError if are_tasks else DeviceError)(
        "a port of the device is taken",
        where=opening.name,
        expected=f"ports {opening.start} to {opening.end} free",
        got=", ".join(
            f"port {one.port}: {one.owner or 'a program'} (process {one.pid})"
            for one in who
        ),
        remedy="let that task read it, and take the value from the table; to take its "
        "place, open it in on, and swap the tasks; kill that one where it is OFF",
    )


def _no_such(opening: Opening, last: int) -> DeviceError:
    return DeviceError(
        "the device has no such ports",
        where=opening.name,
        expected=f"physical ports below {MOST_PORTS}",
        got=str(last),
        remedy=f"see [device.{opening.name}] in agent.toml",
    )


def _unusable(opening: Opening, error: OSError) -> DeviceError:
    return DeviceError(
        "the ports of the device cannot be claimed",
        where=opening.name,
        got=error.strerror or str(error),
        remedy="see that the runtime folder can be written (PBONET_RUN_DIR)",
    )
