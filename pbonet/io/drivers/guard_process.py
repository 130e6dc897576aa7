"""The guard itself: waits for the end of a task, and makes its devices safe then.

See `guard`. A device that does not answer is tried again for some seconds, each one in
a thread of its own, so that none waits for another one. What cannot be made safe is
reported to the system's log.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import syslog
import threading
import time
from importlib import import_module
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from pbonet.errors import PbonetError
from pbonet.outside import Outside

from .device_opening import driver
from .guard import DONE, Forget, Prepare, Watch
from .modes import Mode, Opening, Wait
from .port_claims import SAFE_TIME, Claim

if TYPE_CHECKING:
    from pbonet.config import Entry

    from .device import Device

TRY_TIME: Final = SAFE_TIME / 2
"""Seconds for which a device that cannot be written is tried again."""
_AGAIN: Final = 0.02
"""Seconds between two attempts."""
_LARGEST: Final = 1 << 20


class Watched(NamedTuple):
    """A device, and the claim on its ports."""

    device: Device
    claim: Claim
    owner: str
    """The task."""


class GuardProcess:
    """Knows what a task has open.

    Args:
        sock: The socket to the task.
        task: The pidfd of the task.
    """

    def __init__(self, sock: socket.socket, task: int) -> None:
        self._sock, self._task = sock, task
        self._watched: dict[int, Watched] = {}
        self._decoder = msgspec.msgpack.Decoder(Watch | Forget | Prepare)

    def wait(self) -> None:
        """Return when the task has ended."""
        poll = select.poll()
        poll.register(self._task, select.POLLIN)
        poll.register(self._sock, select.POLLIN)
        while True:
            ready = {fd for fd, _ in poll.poll()}
            # What it has reported before its end counts.
            if self._sock.fileno() in ready:
                if not self._take():
                    poll.unregister(self._sock)
            elif self._task in ready:
                return

    def _take(self) -> bool:
        """Take a message of the task; return False when there will be none."""
        try:
            data, fds, _, _ = socket.recv_fds(self._sock, _LARGEST, 1)
        except ConnectionError:
            return False
        if not data:
            return False
        fault = self._done(data, fds)
        with contextlib.suppress(OSError):  # it has ended
            self._sock.send((fault or DONE).encode()[:4000])
        return True

    def _done(self, data: bytes, fds: list[int]) -> str:
        """Do what a message says; return why it cannot be done, or nothing."""
        message = self._decoder.decode(data)
        if isinstance(message, Forget):
            if gone := self._watched.pop(message.number, None):
                os.close(gone.claim.fd)  # the task releases it
            return ""
        try:
            if isinstance(message, Prepare):
                _loaded(message.entry, message.name, message.modules)
                return ""
            device = _made(message)
            watched = Watched(device, Claim(fds[0]), message.owner)
            self._watched[message.number] = watched
        except Exception as error:  # noqa: BLE001 - the task raises it
            for fd in fds:
                os.close(fd)
            return f"{type(error).__name__}: {error}"
        return ""

    def secure(self) -> None:
        """Make safe what the task has not closed."""
        threads = [
            threading.Thread(target=_make_safe, args=(one,), daemon=True)
            for one in self._watched.values()
        ]
        for one in threads:
            one.start()
        deadline = time.monotonic() + SAFE_TIME
        for one in threads:
            one.join(max(0.0, deadline - time.monotonic()))


def _made(message: Watch) -> Device:
    """Return a device as it was opened, to be opened again when the task is gone."""
    name, start, end, _, _, size, signed, trunc_lsb = message.opening
    cls = _loaded(message.entry, name, message.modules)
    opening = Opening(
        *(name, start, end, Mode.WRITE, Wait.ALL), *(size, signed, trunc_lsb)
    )
    device = cls(message.entry, opening, Outside(f"guard of {name}"))
    device.take_safe(message.safe)
    return device


def _loaded(entry: Entry, name: str, modules: list[str]) -> type[Device]:
    """Load modules, and the driver of a device; return it."""
    for module in modules:
        with contextlib.suppress(Exception):  # it may be a part of the task only
            import_module(module)
    return driver(entry, name)


def _make_safe(one: Watched) -> None:
    """Write the safe values of a device, and give its ports back."""
    deadline = time.monotonic() + TRY_TIME
    try:
        one.claim.hold(one.device.entry, one.device.opening)
    except OSError:  # it was closed, which did not come to here, and is another's now
        return
    try:
        while fault := _tried(one.device):
            if time.monotonic() > deadline:
                text = f"{one.device.name} was not made safe: {fault}"
                syslog.syslog(syslog.LOG_CRIT, text)
                one.claim.note(text, one.owner)
                return
            time.sleep(_AGAIN)
    finally:
        one.claim.release()  # also where a copy of the task has it


def _tried(device: Device) -> str:
    """Write the safe values once; return why that failed, or nothing."""
    try:
        device.open(None)
        device.close()
    except (PbonetError, OSError) as error:
        return str(error)
    except Exception as error:  # noqa: BLE001 - the driver may be anybody's
        return f"{type(error).__name__}: {error}"
    return ""


def main(argv: list[str]) -> int:
    """Guard the task whose socket and pidfd these are."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends when the task has
    sock, task = map(int, argv)
    low, high = sorted((sock, task))
    for begin, end in ((3, low), (low + 1, high), (high + 1, 1 << 16)):
        os.closerange(begin, end)
    syslog.openlog("pbonet-guard")
    guard = GuardProcess(socket.socket(fileno=sock), task)
    guard.wait()
    guard.secure()
    os._exit(0)  # and not wait for a driver that hangs


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
