"""The agent's link to its RTPU process: find or start it, use it, detect its end.

An RTPU process that already runs, because its agent was killed or restarted, is taken
over; its tasks do not notice.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Protocol

import msgspec

import pbonet
from pbonet.errors import NodeError, ProtocolError
from pbonet.node.rtpu import SnapshotChanges, cleanup
from pbonet.node.wire import describe_end, rtpu_messages
from pbonet.xm.net import run_folder

from . import start_rtpu
from .stopped_processes import PERIOD

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

log = logging.getLogger("pbonet.node")

FromRtpu = rtpu_messages.FromRtpu | SnapshotChanges

SEND_TIME = 2.0
"""Seconds after which an RTPU process that does not receive counts as lost."""
AGAIN_TIME = 5.0
"""Seconds in which a live RTPU process must accept its agent again."""
ENDING_TIME = 10.0
"""Seconds in which an RTPU process that ends has ended, or one that starts accepts."""
UNREAD = 5
UNREAD_TIME = 60.0
"""An agent gives up after more than so many unreadable messages in so many seconds."""
_LOOK = 0.05
_LEAST_TRIES = 2
LACKS = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS, errno.EAGAIN)
"""Error numbers for resources that the machine lacks, perhaps only temporarily."""


class _NotAcceptedError(NodeError):
    """The RTPU process has closed the connection: it has an agent, or ends."""


class Listener(Protocol):
    """Receives the messages of the RTPU process; called in the link's thread."""

    def answered(self, n: int, data: bytes) -> None:
        """Process the answer to forwarded request `n`."""

    def published(self, data: bytes) -> None:
        """Process an event for the network."""

    def called(self, call: rtpu_messages.Called) -> None:
        """Call successors on other machines."""

    def informed(self, info: rtpu_messages.RtpuInfo) -> None:
        """Process the changed identity of the RTPU process."""

    def learned(self, news: SnapshotChanges) -> None:
        """Process the RTPU process's report of its state."""

    def broke(self, reason: str) -> None:
        """Handle a broken link that was restored; no process has ended."""

    def let_go(self) -> None:
        """Close its tables, because its remains are about to be removed."""

    def lost(self, how: str, *, again: bool, orderly: bool) -> None:
        """Handle the end of the RTPU process.

        Args:
            how: How it has ended.
            again: Whether to start a new one.
            orderly: Whether it has turned its tasks OFF, and said so.
        """


class RtpuLink:
    """One RTPU process.

    Args:
        places: Its files.
        config: The settings for starting it, unless it runs already.
        listener: Receives its messages.
    """

    def __init__(
        self,
        places: run_folder.Places,
        config: rtpu_messages.RtpuConfig,
        listener: Listener,
    ) -> None:
        self._places = places
        self._config = config
        self._listener = listener
        self._starting: start_rtpu.Starting | None = None
        self._cleaned: list[str] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._sock: socket.socket | None = None
        self._write_lock = threading.Lock()
        self._rest = memoryview(b"")
        """Unsent part of a frame; nothing else may be sent before it."""
        self._thread: threading.Thread | None = None
        self._closing = False
        self._short = False
        """Whether a lack of resources has been reported."""
        self._unread: list[float] = []
        self._misread = ""
        """The error of the last unreadable message."""
        self._decoder: msgspec.msgpack.Decoder[FromRtpu] = msgspec.msgpack.Decoder(
            FromRtpu
        )
        self.taken_over = False
        self.info: rtpu_messages.RtpuInfo | None = None

    def begin(self) -> None:
        """Start an RTPU process if there is none; `open` waits until it is ready.

        Raises:
            OSError: The system cannot create a process.
        """
        if not run_folder.is_held(self._places.ctl_lock):
            self._starting = self._start()

    def open(
        self, given_up: Callable[[], bool] = lambda: False
    ) -> rtpu_messages.RtpuInfo:
        """Take over the running RTPU process, or start one.

        Args:
            given_up: Returns whether one that starts is not wanted any more.

        Raises:
            NodeError: It cannot be started, or is of another version or core.
        """
        info = self._find() if self._starting is None else None
        self.taken_over = info is not None
        if info is None:
            starting, self._starting = self._starting or self._start(), None
            self._process = starting.wait(given_up)
            self._sock = self._connect()
            if self._sock is None:
                raise NodeError(
                    "the RTPU process does not answer",
                    where=self._config.name,
                    remedy="start the agent again; --debug shows its output",
                    debug=start_rtpu.log_tail(self._places),
                )
            info = self._attach(self._sock)
        self.info = info
        self._listener.informed(info)
        self._thread = threading.Thread(
            target=self._live, args=(self._sock,), name="pbonet rtpu link", daemon=True
        )
        self._thread.start()
        for text in self._cleaned:
            self.send(rtpu_messages.Note(30, "CLEANED", text))
        return info

    def _start(self) -> start_rtpu.Starting:
        self._cleaned = cleanup.clean_after(self._places)
        return start_rtpu.Starting(self._places, self._config)

    def send(self, message: msgspec.Struct) -> None:
        """Send a message.

        Raises:
            NodeError: The RTPU process has ended, or does not receive.
        """
        data = memoryview(rtpu_messages.frame(message))
        with self._write_lock:
            sock = self._sock
            if sock is None:
                raise self._gone()
            try:
                self._rest = _send(sock, self._rest)
                rest = data if self._rest else _send(sock, data)
            except OSError:
                raise self._gone() from None
            if len(rest) == len(data):
                raise self._gone()
            self._rest = rest
        if rest:
            threading.Thread(
                target=self._finish, args=(sock,), name="pbonet rtpu rest", daemon=True
            ).start()

    def _finish(self, sock: socket.socket) -> None:
        """Send the rest of an unfinished frame, however long that takes."""
        while True:
            time.sleep(_LOOK)
            with self._write_lock, contextlib.suppress(OSError):
                if sock is not self._sock or not self._rest:
                    return
                self._rest = _send(sock, self._rest, socket.MSG_DONTWAIT)

    def _gone(self) -> NodeError:
        return NodeError(
            "the RTPU process has ended or does not take requests",
            where=self._config.name,
            remedy="try again: its agent starts another one",
        )

    def shut_down(self, timeout: float) -> bool:
        """Let all tasks be turned OFF in order; return whether it ended by itself."""
        self._closing = True
        if self._starting is not None:
            self._starting.end()
        with contextlib.suppress(NodeError):
            self.send(rtpu_messages.Shutdown(timeout))
        by_itself = self._ended(timeout + 3.0, kill=True)
        self.close()
        with contained():
            self._listener.let_go()
        self._clean_up()
        return by_itself

    def close(self) -> None:
        """Close the link; the RTPU process continues for its grace."""
        self._closing = True
        sock = self._sock
        if sock is not None:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)  # the reading thread closes it
            if self._thread is None:
                sock.close()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def leave(self, grace: float) -> None:
        """Close the link for the next agent, which must come within the grace."""
        longer = max(grace, self._config.grace)
        with contextlib.suppress(NodeError):
            self.send(rtpu_messages.Attach(os.getpid(), pbonet.__version__, longer))
        self.close()

    def _clean_up(self) -> None:
        """Remove what the process left; nothing if it ended in order."""
        if self.info is not None:
            self._reap()
            cleanup.clean_after(self._places)

    def _reap(self) -> int | None:
        if self._process is None:
            return None
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(5.0)
        return None

    def _connect(self) -> socket.socket | None:
        """Return a socket connected to it; None if it does not accept.

        Raises:
            OSError: The machine has no sockets left.
        """
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            sock.connect(str(self._places.ctl))
        except OSError:
            sock.close()
            return None
        seconds = int(SEND_TIME)
        limit = seconds.to_bytes(8, sys.byteorder) + bytes(8)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        return sock

    def _find(self) -> rtpu_messages.RtpuInfo | None:
        """Attach to the RTPU process that runs; None if there is none.

        One that ends, because it was without an agent for too long, accepts no agent.
        It is waited for, and so is one that has just been started.

        Raises:
            NodeError: It has another agent, or is of another version or core.
            OSError: It does not answer.
        """
        deadline = time.monotonic() + ENDING_TIME
        while True:
            sock = self._connect()
            over = time.monotonic() > deadline
            if sock is None:
                if over or not run_folder.is_held(self._places.ctl_lock):
                    return None
            else:
                try:
                    self._sock = sock
                    return self._attach(sock)
                except (OSError, _NotAcceptedError):
                    sock.close()
                    self._sock = None
                    if over:
                        raise
            time.sleep(_LOOK)

    def _attach(self, sock: socket.socket) -> rtpu_messages.RtpuInfo:
        """Attach as its agent.

        Raises:
            NodeError: It has another agent, or is of another version or core.
            OSError: It does not answer.
        """
        hello = rtpu_messages.Attach(
            os.getpid(), pbonet.__version__, self._config.grace
        )
        sock.sendall(rtpu_messages.frame(hello))
        data = rtpu_messages.receive_frame(sock)
        if not data:
            raise _NotAcceptedError(
                "the RTPU process of that name has another agent",
                where=self._config.name,
                remedy="choose another name",
            )
        info = self._decode(data)
        if not isinstance(info, rtpu_messages.RtpuInfo):
            raise ProtocolError(
                "the RTPU process did not identify itself",
                remedy="end it, and start the agent again",
            )
        for what, got, wanted in (
            ("version", info.version, pbonet.__version__),
            ("core", info.core, self._config.core),
        ):
            if got != wanted:
                sock.close()
                raise NodeError(
                    f"the running RTPU process has another {what}",
                    where=f"{self._config.name}, process {info.pid}",
                    expected=f"{what} {wanted}",
                    got=f"{what} {got}",
                    remedy=f"end it with `kill {info.pid}`, which turns its tasks OFF",
                )
        return info

    def _live(self, sock: socket.socket) -> None:
        """Read from the RTPU process until it ends; reconnect a broken link."""
        while True:
            reason, orderly = self._read(sock)
            with self._write_lock:
                self._sock, self._rest = None, memoryview(b"")
                sock.close()
            again = None if orderly or self._unreadable else self._again(reason)
            if again is None:
                break
            sock = again
        if self._closing:
            return
        with contained():
            self._listener.let_go()
        if self._unreadable:
            how = f"the RTPU process cannot be understood: {self._misread}"
        else:
            how = f"the RTPU process ended: {self._end(reason, orderly=orderly)}"
        with contained():
            stays = orderly or self._unreadable
            self._listener.lost(how, again=not stays, orderly=orderly)

    def _read(self, sock: socket.socket) -> tuple[str, bool]:
        """Pass messages on; return why they end, and whether it ended in order."""
        while True:
            try:
                data = rtpu_messages.receive_frame(sock)
                if not data:
                    return "its socket was closed", False
                message = self._decode(data)
            except (OSError, NodeError) as error:
                return str(error), False
            if isinstance(message, rtpu_messages.Ending):
                return message.reason, True
            with contained():
                self._hand_over(message)

    def _decode(self, data: bytes) -> FromRtpu:
        """Decode a message of the RTPU process.

        Raises:
            ProtocolError: It cannot be decoded; counted.
        """
        try:
            return self._decoder.decode(data)
        except msgspec.MsgspecError as error:
            now = time.monotonic()
            self._unread = [t for t in self._unread if now - t < UNREAD_TIME] + [now]
            pid = f", process {self.info.pid}" if self.info else ""
            refused = ProtocolError(
                "a message of the RTPU process cannot be read",
                where=f"{self._config.name}{pid}",
                got=str(error),
                remedy="both must be of one installation: within its grace an agent of "
                "the RTPU process's installation can take it over; after that its "
                "tasks are OFF, and any agent can be started",
            )
            self._misread = str(refused)
            raise refused from None

    @property
    def _unreadable(self) -> bool:
        """Whether attaching again would not help."""
        return len(self._unread) > UNREAD

    def _again(self, reason: str) -> socket.socket | None:
        """Attach again if the process is still alive; return the socket.

        There are at least two attempts, even if the whole machine stalled meanwhile. A
        lack of resources such as descriptors is not a fault of the process, and is
        waited out.
        """
        deadline = time.monotonic() + AGAIN_TIME
        tries = 0
        while not (self._closing or self._unreadable):
            try:
                over = tries >= _LEAST_TRIES and time.monotonic() > deadline
                if self._ended(_LOOK) or over:
                    return None
                sock = self._connect()
            except OSError as error:
                self._lacks(error)
                deadline, tries = time.monotonic() + AGAIN_TIME, 0
                continue
            tries += 1
            info = self._taken_back(sock) if sock is not None else None
            if sock is None or info is None:
                continue
            self._short = False
            level = logging.WARNING if len(self._unread) <= 1 else logging.DEBUG
            log.log(level, "%s: the link broke: %s", self._config.name, reason)
            with contained():
                self._listener.broke(reason)
            if not self._use(sock):
                return None
            with contained():
                self._hand_over(info)
            return sock
        return None

    def _taken_back(self, sock: socket.socket) -> rtpu_messages.RtpuInfo | None:
        """Attach as its agent again; None if it is not ready yet, or ends."""
        try:
            sock.settimeout(AGAIN_TIME)
            info = self._attach(sock)
            sock.settimeout(None)
        except (OSError, NodeError):
            sock.close()
            return None
        return info

    def _lacks(self, error: OSError) -> None:
        """Report once which resource is missing, and wait a moment."""
        if not self._short:
            self._short = True
            log.error(
                "%s: the link to the RTPU process cannot be opened again: %s; this is "
                "retried: free the resource, or raise its limit "
                "(LimitNOFILE of a service, or ulimit -n)",
                self._config.name,
                error,
            )
        time.sleep(_LOOK)

    def _use(self, sock: socket.socket) -> bool:
        """Use this socket from now on, unless the link is being closed."""
        with self._write_lock:
            self._sock = sock
        if self._closing:  # by a thread that saw no socket to shut down
            with self._write_lock:
                self._sock = None
                sock.close()
        return not self._closing

    def _ended(self, timeout: float, *, kill: bool = False) -> bool:
        """Return whether the process ended in time; with `kill`, kill it if not."""
        if self.info is None:
            return True
        try:
            pidfd = os.pidfd_open(self.info.pid)
        except ProcessLookupError:
            return True
        try:
            deadline = time.monotonic() + timeout
            ended = False
            while not ended and (left := deadline - time.monotonic()) > 0.0:
                if kill:  # it may be stopped, and later again
                    _send_signal(pidfd, signal.SIGCONT)
                ended = start_rtpu.readable(pidfd, min(left, PERIOD))
            if kill and not ended:
                _send_signal(pidfd, signal.SIGKILL)
                start_rtpu.readable(pidfd, 5.0)
        finally:
            os.close(pidfd)
        return ended

    def _hand_over(self, message: FromRtpu) -> None:
        match message:
            case rtpu_messages.Answered():
                self._listener.answered(message.n, message.data)
            case rtpu_messages.Published():
                self._listener.published(message.data)
            case rtpu_messages.Called():
                self._listener.called(message)
            case rtpu_messages.RtpuInfo():
                self.info = message
                self._listener.informed(message)
            case SnapshotChanges():
                self._listener.learned(message)
            case rtpu_messages.Ending():
                pass

    def _end(self, reason: str, *, orderly: bool) -> str:
        """Return how the process ended, with the end of its log if not in order."""
        while True:
            try:
                self._ended(5.0 if orderly else 1.0, kill=True)
                self._clean_up()
                break
            except OSError as error:
                if self._closing or error.errno not in LACKS:
                    break  # faults of the files are found at the restart
                self._lacks(error)
        if orderly:
            return reason
        code = self._process.returncode if self._process else None
        how = describe_end(code) if code is not None else reason
        said = start_rtpu.log_tail(self._places)
        return f"{how}\n{said}" if said else how


def _send_signal(pidfd: int, which: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):  # it has just ended
        signal.pidfd_send_signal(pidfd, which)


def _send(sock: socket.socket, data: memoryview, flags: int = 0) -> memoryview:
    """Send as much as is accepted; return the rest."""
    with contextlib.suppress(BlockingIOError):
        while data:
            data = data[sock.send(data, flags) :]
    return data


@contextlib.contextmanager
def contained() -> Generator[None]:
    """Log the exceptions of this block; what follows is done."""
    try:
        yield
    except Exception:
        log.exception("a step of the agent has failed; please report it")
