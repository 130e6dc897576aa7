"""The fork server: one thread, numpy and pbonet imported, never zenoh.

The RTPU process starts as one thread that has imported all of this, and forks the fork
server first. A fork server that replaces a dead one is started by exec, because a
process with threads cannot be forked. Requests for children arrive over a socket. A
child is ready in milliseconds with everything imported, and belongs to this process: if
it ends, the kernel signals every child, and each turns itself off.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import os
import selectors
import signal
import socket
import sys
import time
import traceback
from array import array

import msgspec

from pbonet.errors import NodeError, RealTimeError
from pbonet.node import rt
from pbonet.node.wire import process_setup, rtpu_messages

from . import module_inspector, task_output, task_process
from .code_pages import code_pages

FDS = 4
"""Number of files in a request: socket, output, specification, crash text."""
CRASHED = 70
"""Exit code of a child that ended with an uncaught exception."""
SETTLE_TIME = 0.05
"""Seconds after a task's end until its remaining processes are searched for again."""
RESUME_TIME = 2.0
"""Seconds after the agent's end in which the RTPU process is continued if a signal has
stopped it: one that comes with the end takes the kernel's SIGCONT back."""


def beside(core: int, *, close: int) -> tuple[int, socket.socket]:
    """Fork a fork server from this process, which must have only one thread.

    Args:
        core: The RTPU's core.
        close: A descriptor that the fork server must not keep open, or -1.

    Returns:
        Its process id and the socket connected to it.

    Raises:
        NodeError: The system cannot create a process.
    """
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    parent = os.getpid()
    share_objects()
    try:
        pid = os.fork()
    except OSError as error:
        near.close()
        far.close()
        raise NodeError(
            "the system cannot create a process",
            got=error.strerror or str(error),
            remedy="check 'ulimit -u' and the free memory",
        ) from None
    if pid:
        far.close()
        return pid, near
    code = CRASHED
    try:
        near.close()
        if close >= 0:
            os.close(close)
        code = serve(far, parent, core)
    except BaseException:  # noqa: BLE001 - the frames above belong to the parent
        traceback.print_exc()
    finally:
        os._exit(code)


def main(argv: list[str]) -> int:
    """Serve on the socket with the descriptor of the first argument until it closes."""
    return serve(socket.socket(fileno=int(argv[0])), int(argv[1]), int(argv[2]))


def serve(control: socket.socket, parent: int, core: int) -> int:
    """Run as the fork server of process `parent` until the socket is closed.

    Returns:
        The exit status: 0, or 1 if the parent has already ended.
    """
    os.sched_setaffinity(0, process_setup.housekeeping_cores(core))
    if not process_setup.set_parent_death_signal(signal.SIGKILL, parent):
        return 1
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ends it at once, like SIGTERM
    process_setup.set_title("pbonet-forks")
    process_setup.adopt_descendants()
    prepared = task_process.Prepared()
    if gc.get_freeze_count():
        gc.freeze()
    else:  # started by exec
        share_objects()
    server = ForkServer(control, prepared)
    control.send(rtpu_messages.encode(rtpu_messages.Ready()))
    return server.serve()


def share_objects() -> None:
    """Prepare this process's objects for being shared with its future children.

    A collection writes to each object that it visits. Frozen ones are not visited, in
    this process and in its children.
    """
    gc.collect()
    code_pages()
    gc.freeze()


class ForkServer:
    """Forks children on request and reports their ends.

    Args:
        control: The socket to the RTPU process.
        prepared: What was done for the children.
    """

    def __init__(self, control: socket.socket, prepared: task_process.Prepared) -> None:
        self._control = control
        self._prepared = prepared
        self._children: dict[int, int] = {}
        """Process ids by the descriptor that is readable at the end."""
        self._resume_until = 0.0
        """Until when the RTPU process is continued if it is stopped."""
        self._rest = False
        """A task has ended, and more of its processes may become children here."""
        self._decoder = msgspec.msgpack.Decoder(rtpu_messages.Fork)
        self._selector = selectors.DefaultSelector()
        self._selector.register(control, selectors.EVENT_READ)
        self._agent = self._watched_agent()

    def serve(self) -> int:
        """Serve until the RTPU process closes the socket."""
        while True:
            resumes = time.monotonic() < self._resume_until
            waits = self._rest or resumes
            ready = self._selector.select(SETTLE_TIME if waits else None)
            if resumes:
                process_setup.resume(os.getppid())
            if self._rest and not ready:
                self._rest = self._end_rest()
            for key, _ in ready:
                if key.fileobj is self._control:
                    if not self._take_request():
                        self._end_rest()
                        return 0
                elif key.fd == self._agent:
                    self._agent_ended()
                else:
                    self._report_end(int(key.fd))

    def _watched_agent(self) -> int:
        """Return a descriptor that is readable when the agent ends; -1: it has."""
        rtpu = process_setup.stat(os.getppid())
        try:
            agent = os.pidfd_open(rtpu.parent if rtpu is not None else 0)
        except OSError:
            return -1
        self._selector.register(agent, selectors.EVENT_READ)
        return agent

    def _agent_ended(self) -> None:
        self._selector.unregister(self._agent)
        os.close(self._agent)
        self._agent = -1
        self._resume_until = time.monotonic() + RESUME_TIME

    def _take_request(self) -> bool:
        data, fds = receive_with_fds(self._control)
        if not data:
            return False
        request = self._decoder.decode(data)
        try:
            pid = self._fork(request, fds)
        except OSError as error:
            answer = rtpu_messages.Forked(request.n, 0, error.strerror or str(error))
        else:
            answer = rtpu_messages.Forked(request.n, pid)
        for fd in fds:
            os.close(fd)
        self._control.send(rtpu_messages.encode(answer))
        return True

    def _fork(self, request: rtpu_messages.Fork, fds: list[int]) -> int:
        server = os.getpid()
        guarded = _guarded(server)
        self._prepared.check()
        pid = os.fork()
        if pid == 0:
            code = CRASHED
            try:
                code = become_child(request, fds, server, guarded)
            finally:
                os._exit(code)
        pidfd = os.pidfd_open(pid)
        self._children[pidfd] = pid
        self._selector.register(pidfd, selectors.EVENT_READ)
        return pid

    def _report_end(self, pidfd: int) -> None:
        self._selector.unregister(pidfd)
        os.close(pidfd)
        pid = self._children.pop(pidfd)
        with contextlib.suppress(OSError):  # before its id can be used again
            os.killpg(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        self._end_rest()
        self._rest = True
        code = os.waitstatus_to_exitcode(status)
        self._control.send(rtpu_messages.encode(rtpu_messages.Exited(pid, code)))

    def _end_rest(self) -> bool:
        """End the processes that ended tasks have left, and reap them.

        Returns whether there were any: others whose parents were among them may follow.

        They became children of this process when their own parent ended. One in the
        session of a living task may still be used by it.
        """
        tasks, found = set(self._children.values()), False
        for pid in process_setup.own_children():
            one = process_setup.stat(pid)
            if one is None or pid in tasks:
                continue
            if one.session in tasks and one.state != "Z":
                continue
            if process_setup.has_in_environment(pid, _guard_mark()):
                found = True  # it makes the devices of a task safe, and ends then
                continue
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                found = True
        return found


def _guard_mark() -> str:
    from pbonet.io.drivers import GUARD  # only where a task has left a process

    return GUARD


def become_child(
    request: rtpu_messages.Fork, fds: list[int], server: int, guarded: list[int]
) -> int:
    """Turn the process just forked into a task or an inspector; return its exit code.

    Never raises: errors are written to the file that the RTPU process reads.
    """
    sock_fd, spec_fd, crash_fd = _arrange_fds(fds)
    try:
        os.setsid()  # with its own children it is one group, which ends with it
        task_output.take_over()
        process_setup.set_title(request.title)
        faulthandler.enable(crash_fd, all_threads=False)  # other threads keep running
        with contextlib.suppress(RealTimeError):  # the RTPU reports it, once
            rt.restrict(guarded)
        run = module_inspector.run if request.kind == "inspect" else task_process.run
        return run(sock_fd, spec_fd, crash_fd, server)
    except BaseException:  # noqa: BLE001 - the process ends, and the RTPU is notified
        with contextlib.suppress(OSError):
            os.write(crash_fd, traceback.format_exc().encode())
        return CRASHED


def _guarded(server: int) -> list[int]:
    """Return what a module must not kill: fork server, RTPU process, agent, all."""
    rtpu = process_setup.stat(server)
    agent = process_setup.stat(rtpu.parent) if rtpu else None
    pids = [
        server,
        *([rtpu.parent] if rtpu else []),
        *([agent.parent] if agent else []),
    ]
    return [-1, *(one for pid in pids if pid > 1 for one in (pid, -pid))]


def _arrange_fds(fds: list[int]) -> tuple[int, int, int]:
    """Keep only the files of this child, numbered from 3; output becomes 1 and 2."""
    base = max(fds) + 1
    for i, fd in enumerate(fds):
        os.dup2(fd, base + i, inheritable=False)
    os.closerange(3, base)
    os.closerange(base + FDS, 1 << 20)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    os.dup2(base + 1, 1)
    os.dup2(base + 1, 2)
    for low, high in ((3, base), (4, base + 2), (5, base + 3)):
        os.dup2(high, low, inheritable=False)
    os.closerange(6, base + FDS)
    return 3, 4, 5


def receive_with_fds(sock: socket.socket) -> tuple[bytes, list[int]]:
    """Return the next packet and the files sent with it; b"" at the end.

    Raises:
        NodeError: A packet has no files.
    """
    fds = array("i")
    data, ancillary, _, _ = sock.recvmsg(65536, socket.CMSG_SPACE(FDS * fds.itemsize))
    for level, kind, payload in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            fds.frombytes(payload[: len(payload) - len(payload) % fds.itemsize])
    if data and len(fds) != FDS:
        raise NodeError(
            "a request to fork came without its files",
            got=f"{len(fds)}",
            remedy="please report it: this is a fault inside pbonet",
        )
    return data, list(fds)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
