"""A process beside the task that makes its devices safe when it is gone.

After SIGKILL no line of the task runs any more. So each process that opens a device
with safe values has one guard, a process in a session of its own. The task tells it
what it has open. When the task has ended, however it did, the guard opens each device
that was not closed, writes the safe values, gives the ports back, and ends.

The kernel tells the guard of the end of the task by a pidfd. It needs no other process
for that: not the RTPU process, the fork server or the agent.
"""

from __future__ import annotations

import errno
import itertools
import os
import socket
import sys
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct

from pbonet.config import Entry
from pbonet.errors import DeviceError

from . import database

if TYPE_CHECKING:
    from .modes import Opening

GUARD: Final = "PBONET_DEVICE_GUARD"
"""Is in the environment of a guard, so that what ends the processes that a task has
left does not end it; its value is the task's process id."""
DONE: Final = "done"
"""The answer of a guard that has carried out a message."""
_ANSWER_TIME: Final = 20.0
"""Seconds in which a guard begins, and answers."""
_SMALL_TIME: Final = 0.5
"""Seconds in which a guard that runs answers; after that the task goes on."""


class Watch(Struct, tag="watch", frozen=True, kw_only=True):
    """A device that was opened; the descriptor of its claim comes with it."""

    number: int
    entry: Entry
    opening: tuple[str, int, int, int, str, int, bool, bool]
    """An `Opening`; the mode and the wait are their values."""
    safe: Any
    modules: list[str]
    """Python modules that were loaded to open it, to be loaded in advance."""
    owner: str
    """The task, as `database.owner` has it."""


class Forget(Struct, tag="forget", frozen=True, kw_only=True):
    """A device that was closed, or is lost."""

    number: int


class Prepare(Struct, tag="prepare", frozen=True, kw_only=True):
    """A device that will be opened, so that its driver is loaded in advance."""

    entry: Entry
    name: str
    modules: list[str]


def flat(opening: Opening) -> tuple[str, int, int, int, str, int, bool, bool]:
    """Return an opening as `Watch` has it."""
    o = opening
    return (
        *(o.name, o.start, o.end, o.mode.value, o.wait.value),
        *(o.size, o.signed, o.trunc_lsb),
    )


class Guard:
    """This process's end of its guard."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._sock, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        mine = os.pidfd_open(self.owner)
        try:
            self.pid = _started(far.fileno(), mine, self.owner)
        except OSError:
            self._sock.close()
            raise
        finally:
            far.close()
            os.close(mine)
        self._sock.settimeout(_ANSWER_TIME)

    def watch(self, entry: Entry, opening: Opening, told: Told, claim: int) -> int:
        """Tell it of a device; return the number by which it forgets it.

        Raises:
            OSError: It does not answer.
            DeviceError: It cannot use the driver.
        """
        number = next(_numbers)
        message = Watch(
            number=number,
            entry=entry,
            opening=flat(opening),
            safe=told.safe,
            modules=told.modules,
            owner=database.owner(),
        )
        socket.send_fds(self._sock, [msgspec.msgpack.encode(message)], [claim])
        if (fault := self._answer()) != DONE:
            raise DeviceError(
                "the device cannot be made safe when the task is gone",
                where=opening.name,
                got=fault,
                remedy="see that its driver can be imported by a process of its own",
            )
        return number

    def forget(self, number: int) -> None:
        """Have it forget a device, and give up its part in the claim.

        Raises:
            OSError: It does not answer.
        """
        self._sock.settimeout(_SMALL_TIME)
        try:
            self._sock.send(msgspec.msgpack.encode(Forget(number=number)))
            self._answer()
        finally:
            self._sock.settimeout(_ANSWER_TIME)

    def prepare(self, entry: Entry, name: str, modules: list[str]) -> None:
        """Have it load the driver of a device that will be opened.

        Raises:
            OSError: It does not answer.
        """
        message = Prepare(entry=entry, name=name, modules=modules)
        self._sock.send(msgspec.msgpack.encode(message))
        self._answer()

    def _answer(self) -> str:
        data = self._sock.recv(4096)
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "the guard has ended")
        return data.decode(errors="replace")

    def close(self) -> None:
        """Leave it alone: it does not answer."""
        self._sock.close()


class Told(Struct, frozen=True):
    """The part of a `Watch` that the opening does not have."""

    safe: Any
    modules: list[str]


_numbers: Final = itertools.count(1)
"""Numbers of devices, also over guards: one that is replaced gives none again."""
_guards: list[Guard] = []
"""The guard of this process, if it has one; a copy made by fork has its parent's."""


def guard() -> Guard:
    """Return the guard of this process; it is started when it is first needed.

    Raises:
        OSError: The system cannot create a process.
    """
    if _guards and _guards[0].owner != os.getpid():
        _guards.clear()
    if not _guards:
        _guards.append(Guard())
    return _guards[0]


def watch(entry: Entry, opening: Opening, told: Told, claim: int) -> int:
    """Have a device made safe when this process is gone; return its number.

    A guard that was killed is replaced; what it knew is not guarded any more.

    Raises:
        DeviceError: There can be no guard.
    """
    why = ""
    for _ in range(2):
        try:
            return guard().watch(entry, opening, told, claim)
        except DeviceError:
            raise
        except OSError as error:
            why = error.strerror or str(error)
            lose()
    raise DeviceError(
        "no process can guard the device",
        where=opening.name,
        expected="a process that makes it safe when the task is gone",
        got=why,
        remedy="check 'ulimit -u' and the free memory; with safe=None nothing guards",
    )


def prepare(entry: Entry, name: str, modules: list[str]) -> None:
    """Start the guard of this process and have it load a driver, ahead of `watch`.

    What fails here fails again in `watch`, which says so.
    """
    try:
        guard().prepare(entry, name, modules)
    except OSError:
        lose()


def forget(number: int) -> None:
    """Have a device not be made safe any more, because it was closed or is lost."""
    if not _guards or _guards[0].owner != os.getpid():
        return
    try:
        _guards[0].forget(number)
    except OSError:
        lose()


def lose() -> None:
    """Give the present guard up."""
    while _guards:
        _guards.pop().close()


def _started(sock: int, task: int, owner: int) -> int:
    """Start a guard with two descriptors; return its process id.

    It has nothing of the task: neither its session, nor its signals, nor its files.
    """
    for fd in (sock, task):
        os.set_inheritable(fd, True)  # noqa: FBT003 - as os has it
    env = {key: value for key, value in os.environ.items() if key[:7] != "PBONET_"}
    env[GUARD] = str(owner)
    env["PYTHONPATH"] = os.pathsep.join(one or os.getcwd() for one in sys.path)  # noqa: PTH109
    null = [(os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_RDWR, 0) for fd in range(3)]
    command = [sys.executable, "-P", "-m", f"{__package__}.guard_process"]
    return os.posix_spawn(
        command[0],
        [*command, str(sock), str(task)],
        env,
        file_actions=null,
        setsid=True,
        setsigmask=(),
    )
