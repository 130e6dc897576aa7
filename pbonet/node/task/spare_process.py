"""A process that is kept ready for the next task, its memory already its own.

A fork shares its memory with its parent until one of them writes to it. A task must not
wait for a page in a cycle, so all of them are copied before it is OFF, which is half of
what a spawn takes. The spare has done that when a request comes. It copies them only
while no other process wants the core, if the system lets it return from that.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.errors import RealTimeError
from pbonet.node import rt
from pbonet.node.wire import process_setup

if TYPE_CHECKING:
    from collections.abc import Callable

    Use = Callable[[bytes, list[int], int], int]

KEPT_TIME = 10.0
"""Seconds from the last request for which a spare takes memory."""
TITLE = "pbonet-spare"
_FIRST = "1000"
"""The kernel's score of a process that it ends before others when memory is short."""
_RECEIVING = 3
"""Descriptor of the socket on which it waits."""


class SpareProcess:
    """The fork server's side: makes the spare, uses it, and ends it.

    Args:
        receive: Returns the next request on a socket, with its files.
        become: Turns the spare into a task; called there with the request, its files
            and the fork server's process id. Returns the exit code.
    """

    def __init__(
        self, receive: Callable[[socket.socket], tuple[bytes, list[int]]], become: Use
    ) -> None:
        self._receive = receive
        self._become = become
        self._sock: socket.socket | None = None
        self._until = 0.0
        self._yields = True
        """Whether it runs as SCHED_IDLE: the system lets it return from there."""
        self.pid = 0
        """Its process id; 0: there is none."""

    def prepare(self) -> None:
        """Make one, unless there is one or the system has no room for it."""
        self._until = time.monotonic() + KEPT_TIME
        if self.pid:
            return
        try:
            near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except OSError:
            return
        server = os.getpid()
        try:
            self.pid = os.fork()
        except OSError:
            near.close()
        else:
            if not self.pid:
                self._live(far, server)
            self._sock = near
            self._yield_cores()
        far.close()

    def _yield_cores(self) -> None:
        """Let it run only while no other process wants the core.

        Capabilities do not show whether it may return from there: in a user namespace
        a process has all of them, and the kernel refuses. Another one is made then.
        """
        try:
            for policy in (os.SCHED_IDLE, os.SCHED_OTHER, os.SCHED_IDLE):
                self._schedule(policy)
        except OSError:
            self._yields = False
            self.drop()
            self.prepare()

    def use(self, data: bytes, fds: list[int]) -> int:
        """Hand it a request; return its process id, or 0 if there is none.

        It is a child like any other from now on.
        """
        pid, sock = self.pid, self._sock
        if sock is None:
            return 0
        try:
            self._schedule(os.SCHED_OTHER)  # it may still copy its memory
            os.kill(pid, signal.SIGCONT)  # it may be stopped
            socket.send_fds(sock, [data], fds)
        except OSError:  # it has ended
            self.drop()
            return 0
        sock.close()
        self.pid, self._sock = 0, None
        return pid

    def _schedule(self, policy: int) -> None:
        if self._yields:
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(self.pid, policy, os.sched_param(0))

    def time_left(self) -> float | None:
        """Return the seconds until it is dropped; None if there is none."""
        return max(self._until - time.monotonic(), 0.0) if self.pid else None

    def drop(self) -> None:
        """End it, and give its memory back."""
        if self._sock is None:
            return
        self._sock.close()
        with contextlib.suppress(OSError):
            self._schedule(os.SCHED_OTHER)  # so that its end is not slow
        with contextlib.suppress(OSError):
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        self.pid, self._sock = 0, None

    def _live(self, sock: socket.socket, server: int) -> None:
        """Be the spare: copy the memory, wait for a request; does not return."""
        code = 1
        try:
            fd = _alone_with(sock)
            if process_setup.set_parent_death_signal(signal.SIGKILL, server):
                process_setup.set_title(TITLE)
                before = _set_oom_score(_FIRST)
                _copy_memory()
                if self._yields:
                    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
                with socket.socket(fileno=fd) as mine:
                    data, fds = self._receive(mine)
                _set_oom_score(before)
                code = self._become(data, fds, server) if data else 0
        finally:
            os._exit(code)


def _alone_with(sock: socket.socket) -> int:
    """Close all files but this one and the standard ones; return its new number."""
    fd = sock.detach()
    if fd != _RECEIVING:
        os.dup2(fd, _RECEIVING, inheritable=False)
    os.closerange(_RECEIVING + 1, 1 << 20)
    return _RECEIVING


def _set_oom_score(score: str) -> str:
    """Set whom the kernel ends when memory is short; return what was set before."""
    file = Path("/proc/self/oom_score_adj")
    with contextlib.suppress(OSError):
        before = file.read_text("ascii")
        file.write_text(score, "ascii")
        return before
    return score


def _copy_memory() -> None:
    """Make all pages this process's own."""
    with contextlib.suppress(RealTimeError):  # the task reports it
        rt.lock_memory()
    rt.populate_pages()
