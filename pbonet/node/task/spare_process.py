"""A process that is kept ready for the next task, its memory already its own.

A fork shares its memory with its parent until one of them writes to it. A task must not
wait for a page in a cycle, so all of them are copied before it is OFF, which is half of
what a spawn takes. The spare has done that when a request comes. Until then it runs
only while no other process wants the core, if its server has the right to end that.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
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
        self._yields = rt.may_set_priorities()
        self.pid = 0
        """Its process id; 0: there is none."""

    def prepare(self) -> None:
        """Make one, unless there is one or the system has no room for it."""
        self._until = time.monotonic() + KEPT_TIME
        if self.pid:
            return
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        server = os.getpid()
        try:
            self.pid = os.fork()
        except OSError:
            near.close()
        else:
            if not self.pid:
                self._live(far, server)
            self._sock = near
            self._schedule(os.SCHED_IDLE)
        far.close()

    def use(self, data: bytes, fds: list[int]) -> int:
        """Hand it a request; return its process id, or 0 if there is none.

        It is a child like any other from now on.
        """
        pid, sock = self.pid, self._sock
        if sock is None:
            return 0
        try:
            self._schedule(os.SCHED_OTHER)
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
                _copy_memory()
                data, fds = self._receive(socket.socket(fileno=fd))
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


def _copy_memory() -> None:
    """Make all pages this process's own."""
    with contextlib.suppress(RealTimeError):  # the task reports it
        rt.lock_memory()
    rt.populate_pages()
