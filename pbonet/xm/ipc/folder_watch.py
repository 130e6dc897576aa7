"""Detects changes of shared memory folders that are listed repeatedly."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import time
from typing import Final

TICK_NS = 20_000_000
"""Resolution of a folder's time stamp: the kernel's clock tick, some milliseconds."""


class Changes:
    """Detects whether a file was made or removed in a folder.

    After a change the folder must be listed until its time stamp has not changed for
    longer than a tick: the stamp cannot show a change directly after a listing.

    Args:
        path: The folder.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._stamp = -1
        self._since = 0
        self._settled = False

    def changed(self) -> bool:
        """Return whether the folder must be listed now."""
        try:
            stamp = os.stat(self._path).st_mtime_ns  # noqa: PTH116 - three times as fast
        except FileNotFoundError:  # removed, with all files in it
            stamp = 0
        if stamp == self._stamp and self._settled:
            return False
        now = time.monotonic_ns()
        if stamp != self._stamp:
            self._stamp, self._since = stamp, now
        self._settled = now - self._since > TICK_NS
        return True


_MADE_OR_REMOVED: Final = 0x100 | 0x200 | 0x40 | 0x80
"""IN_CREATE, IN_DELETE, IN_MOVED_FROM and IN_MOVED_TO of inotify(7)."""
_EVENTS: Final = 65536
"""Bytes that are read at once."""


class Waiting:
    """Waits until a file is made or removed in a folder, or another thread wakes it.

    Args:
        path: The folder.
    """

    def __init__(self, path: str) -> None:
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._inotify = _inotify(path)
        self.hears: bool = self._inotify >= 0
        """Whether the kernel reports changes; if not, `wait` must have a limit."""
        self._poll = select.poll()
        for fd in (self._wake, self._inotify)[: 1 + self.hears]:
            self._poll.register(fd, select.POLLIN)

    def wake(self) -> None:
        """End the wait; may be called from any thread."""
        os.eventfd_write(self._wake, 1)

    def wait(self, seconds: float | None) -> None:
        """Wait for at most so many seconds; None: without a limit."""
        self._poll.poll(None if seconds is None else seconds * 1000)
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        if self.hears:
            with contextlib.suppress(BlockingIOError):
                os.read(self._inotify, _EVENTS)

    def close(self) -> None:
        """Release it. Nothing may call `wake` from here on."""
        os.close(self._wake)
        if self.hears:
            os.close(self._inotify)


def _inotify(path: str) -> int:
    """Return a file that can be read when `path` changes; -1 if there is none."""
    libc = ctypes.CDLL(None)
    fd: int = libc.inotify_init1(os.O_CLOEXEC | os.O_NONBLOCK)
    if fd >= 0 and libc.inotify_add_watch(fd, os.fsencode(path), _MADE_OR_REMOVED) < 0:
        os.close(fd)
        return -1
    return fd
