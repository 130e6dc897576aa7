"""The RTPU process's side of the fork server: requests children, learns their ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import socket
import sys
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from pbonet.errors import NodeError
from pbonet.node.task import PIPE_BYTES
from pbonet.node.wire import CoreWait, process_setup, rtpu_messages

if TYPE_CHECKING:
    from collections.abc import Callable

F_SETPIPE_SZ = 1031
FORK_TIME = 10.0
END_TIME = 1.0
"""Seconds in which a fork server ends, and reports the end of a child."""
LARGEST_CROWD = 128
"""Processes that a task may have besides its own; threads do not count."""
ROUSE_PERIOD = 0.1
"""Seconds between signals to a child that may wait; without `off` it ends in one."""
START_TIME = 20.0
"""Seconds that a fork server may take to import everything, on a busy machine."""


class Child:
    """A forked child as the RTPU process holds it.

    Attributes:
        pid: Its process id.
        started: What `runtime.start_time` says; names it together with `pid`.
        sock: The near end of its socket, non-blocking.
        out: The reading end of what it prints, non-blocking.
        exited: Resolves to its exit code, to minus the signal that ended it, or to
            `process_setup.ORPHANED`.
    """

    def __init__(
        self, pid: int, sock: socket.socket, out: int, crash: int, spec: int
    ) -> None:
        self.pid = pid
        self.started = process_setup.start_time(pid)
        self.sock = sock
        self.out = out
        self._crash = crash
        self._spec = spec
        try:
            self._pidfd = os.pidfd_open(pid)
        except ProcessLookupError:  # it has ended, and the fork server knows already
            self._pidfd = -1
        self.exited: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.exited.add_done_callback(self._no_more)

    def _no_more(self, _code: object) -> None:
        """End what is read after the last packet, if others hold the far end."""
        with contextlib.suppress(OSError):
            self.sock.shutdown(socket.SHUT_RD)

    def crash_text(self) -> str:
        """Return what the child wrote about its end: a traceback, or nothing."""
        return _read_all(self._crash).decode(errors="replace").strip()

    def result(self) -> bytes:
        """Return what an inspector wrote over its specification."""
        return _read_all(self._spec)

    def send_signal(self, which: signal.Signals) -> None:
        """Send a signal to this very process; harmless when it is gone."""
        if self._pidfd >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, which)

    def rouse(self, which: signal.Signals) -> None:
        """Send a signal again and again until the end: one may come just too early."""
        if not self.exited.done():
            self.send_signal(which)
            asyncio.get_running_loop().call_later(ROUSE_PERIOD, self.rouse, which)

    def core_wait(self) -> CoreWait:
        """Return what counts from now on how long it waits for its core."""
        return CoreWait(self.pid)

    def watch(self, ended: Callable[[Child], None]) -> None:
        """Call `ended` when the process has ended, also if its parent has."""
        loop = asyncio.get_running_loop()
        if self._pidfd < 0:
            loop.call_soon(ended, self)
            return
        pidfd = os.dup(self._pidfd)

        def readable() -> None:
            loop.remove_reader(pidfd)
            os.close(pidfd)
            ended(self)

        loop.add_reader(pidfd, readable)

    def ended_unreported(self) -> None:
        """Resolve `exited` without the code, which only its parent has known."""
        if not self.exited.done():
            self.exited.set_result(process_setup.ORPHANED)

    def close(self) -> None:
        """Close all files of the child; it should have ended."""
        self.sock.close()
        for fd in (self.out, self._crash, self._spec, self._pidfd):
            with contextlib.suppress(OSError):
                os.close(fd)
        self._pidfd = -1


def _read_all(fd: int) -> bytes:
    return os.pread(fd, os.fstat(fd).st_size, 0)


class Server(NamedTuple):
    """A fork server: a child of this process, and the socket to it."""

    pid: int
    control: socket.socket

    def wait(self) -> int:
        """Wait for its end, and return its exit code or minus its signal.

        One that does not end within a second is killed.
        """
        pidfd = os.pidfd_open(self.pid)
        waiting = select.poll()
        waiting.register(pidfd, select.POLLIN)
        try:
            signal.pidfd_send_signal(pidfd, signal.SIGCONT)  # it may be stopped
            if not waiting.poll(END_TIME * 1000):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        finally:
            os.close(pidfd)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


class Spawner:
    """Owns the fork server, replaces it when it ends, and forks children through it.

    Args:
        core: The RTPU's core.
        first: The fork server that this process forked when it began, if it did.
        died: Called with the exit code when the fork server ends unasked.
    """

    def __init__(
        self, core: int, first: Server | None, died: Callable[[int], None]
    ) -> None:
        self._core = core
        self._died = died
        self._first: Server | None = first
        self._server: Server | None = None
        self._waiting: dict[int, asyncio.Future[int]] = {}
        self._children: dict[int, Child] = {}
        self._early: dict[int, int] = {}
        self._count = 0
        self._lock = asyncio.Lock()
        self._reader: asyncio.Task[None] | None = None
        self._decoder: msgspec.msgpack.Decoder[rtpu_messages.FromForkServer] = (
            msgspec.msgpack.Decoder(rtpu_messages.FromForkServer)
        )

    @property
    def pid(self) -> int:
        """The fork server's process id, 0 when there is none."""
        return self._server.pid if self._server else 0

    def crowds(self) -> dict[int, int]:
        """Return tasks that have more processes than they may, with their number.

        RLIMIT_NPROC would count what other programs of the user start, and does not
        apply to root. Orphans are children of the fork server, in their task's session.
        """
        adopted = Counter(
            one.session
            for pid in process_setup.listed_children(self.pid)
            if pid not in self._children and (one := process_setup.stat(pid))
        )
        found = {
            pid: process_setup.descendants(pid, LARGEST_CROWD) + adopted[pid]
            for pid in self._children
        }
        return {pid: count for pid, count in found.items() if count > LARGEST_CROWD}

    async def start(self) -> None:
        """Wait until the first fork server can fork, or start another one.

        Raises:
            NodeError: It did not come up.
        """
        server, self._first = self._first or _by_exec(self._core), None
        server.control.settimeout(0)
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(START_TIME):
                ready = await loop.sock_recv(server.control, 65536)
        except (TimeoutError, OSError):
            ready = b""
        if not ready:
            os.kill(server.pid, signal.SIGKILL)
            server.control.close()
            raise NodeError(
                "the fork server did not start",
                got=f"exit code {server.wait()}",
                remedy="see the RTPU process's log in the runtime folder",
            )
        self._server = server
        self._reader = asyncio.create_task(
            self._read(server.control), name="fork server"
        )

    async def fork(self, kind: str, title: str, spec: msgspec.Struct) -> Child:
        """Fork a child of `kind` that finds `spec` in its memory file.

        Raises:
            NodeError: The system cannot create a process, or there is no fork server.
        """
        async with self._lock:
            if self._server is None:
                await self.start()
        with contextlib.ExitStack() as far_ends:
            near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            far_ends.enter_context(far)
            near.settimeout(0)
            out, out_far = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
            far_ends.callback(os.close, out_far)
            spec_fd = _memory_file("spec", rtpu_messages.encode(spec))
            crash_fd = _memory_file("crash", b"")
            with contextlib.suppress(OSError):  # the user's pipe quota may be used up
                import fcntl

                fcntl.fcntl(out_far, F_SETPIPE_SZ, PIPE_BYTES)
            try:
                pid = await self._ask(
                    kind, title, [far.fileno(), out_far, spec_fd, crash_fd]
                )
            except BaseException:
                near.close()
                for fd in (out, spec_fd, crash_fd):
                    os.close(fd)
                raise
        child = Child(pid, near, out, crash_fd, spec_fd)
        self._children[pid] = child
        if pid in self._early:
            self._end(pid, self._early.pop(pid))
        child.watch(self._ended)
        return child

    def _ended(self, child: Child) -> None:
        """Take note that a child is gone; its fork server reports the exit code."""
        if child.pid not in self._children:  # reported, or its fork server has ended
            child.ended_unreported()
            return
        if self._server is not None:  # it may be stopped
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._server.pid, signal.SIGCONT)
        asyncio.get_running_loop().call_later(END_TIME, child.ended_unreported)

    async def _ask(self, kind: str, title: str, fds: list[int]) -> int:
        server = self._server
        if server is None:
            raise NodeError(
                "the fork server has ended",
                remedy="spawn it again: another fork server is started then",
            )
        self._count += 1
        n = self._count
        answer: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._waiting[n] = answer
        request = rtpu_messages.Fork(n, kind, title)
        try:
            os.kill(server.pid, signal.SIGCONT)  # it may be stopped
            socket.send_fds(server.control, [rtpu_messages.encode(request)], fds)
            async with asyncio.timeout(FORK_TIME):
                return await answer
        except (OSError, TimeoutError) as error:
            raise NodeError(
                "the fork server does not fork",
                got=str(error) or "no answer",
                remedy="spawn it again: another fork server is started then",
            ) from None
        finally:
            self._waiting.pop(n, None)

    async def _read(self, control: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                data = await loop.sock_recv(control, 65536)
            except OSError:
                data = b""
            if not data:
                break
            message = self._decoder.decode(data)
            if isinstance(message, rtpu_messages.Forked):
                self._forked(message)
            elif message.pid in self._children:
                self._end(message.pid, message.code)
            else:
                self._early[message.pid] = message.code
        self._lost()

    def _forked(self, message: rtpu_messages.Forked) -> None:
        answer = self._waiting.get(message.n)
        if answer is None or answer.done():
            return
        if message.error:
            answer.set_exception(
                NodeError(
                    "the system cannot create a process",
                    got=message.error,
                    remedy="check 'ulimit -u' and the free memory",
                )
            )
        else:
            answer.set_result(message.pid)

    def _end(self, pid: int, code: int) -> None:
        child = self._children.pop(pid)
        if not child.exited.done():
            child.exited.set_result(code)

    def _lost(self) -> None:
        """Handle the end of the fork server; its children end by themselves."""
        server, self._server = self._server, None
        if server is not None:
            server.control.close()
        for answer in self._waiting.values():
            if not answer.done():
                answer.set_exception(
                    NodeError(
                        "the fork server has ended",
                        remedy="spawn it again: another fork server is started then",
                    )
                )
        self._children.clear()
        if server is not None:
            self._died(server.wait())

    async def close(self) -> None:
        """End the fork server; its children should have ended."""
        if self._reader is not None:
            self._reader.cancel()
            await asyncio.gather(self._reader, return_exceptions=True)
        for server in (self._first, self._server):
            if server is not None:
                server.control.close()
                server.wait()
        self._first = self._server = None


def _by_exec(core: int) -> Server:
    """Start a fork server in a fresh interpreter: this process has threads now."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    arguments = [str(far.fileno()), str(os.getpid()), str(core)]
    far.set_inheritable(True)
    command = [sys.executable, "-P", "-m", "pbonet.node.task.fork_server", *arguments]
    nothing = (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)
    pid = os.posix_spawn(
        sys.executable, command, process_setup.environment(), file_actions=[nothing]
    )
    far.close()
    return Server(pid, near)


def _memory_file(name: str, content: bytes) -> int:
    fd = os.memfd_create(f"pbonet-{name}", os.MFD_CLOEXEC)
    view = memoryview(content)
    while view:
        view = view[os.write(fd, view) :]
    return fd
