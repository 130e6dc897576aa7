"""The agent's side of its RTPU process: finds or starts it, talks to it, hears its end.

An RTPU process that runs already, because its agent was killed or restarted, is taken
over as it is; its tasks don't notice.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import msgspec

import pbonet
from pbonet.errors import NodeError, PbonetError, ProtocolError

from . import leftovers, runtime, wire
from .known import Known

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from pbonet.xm import rundir

log = logging.getLogger("pbonet.node")

FromRtpu = wire.FromRtpu | Known

START_TIME = 30.0
"""Seconds that an RTPU process may take to come up on a busy machine."""
SEND_TIME = 2.0
"""Seconds after which an RTPU process that takes nothing counts as lost."""
AGAIN_TIME = 5.0
"""Seconds in which an RTPU process that lives must take its agent back."""
_LOOK = 0.05
_LEAST_TRIES = 2
LOG_TAIL = 4000


class Listener(Protocol):
    """Who hears what the RTPU process says; called in the link's thread."""

    def answered(self, n: int, data: bytes) -> None:
        """Take the answer to forwarded request `n`."""

    def published(self, data: bytes) -> None:
        """Take an event for the network."""

    def informed(self, info: wire.RtpuInfo) -> None:
        """Take who the RTPU process is, as it has changed."""

    def learned(self, news: Known) -> None:
        """Take what the RTPU process knows now."""

    def broke(self, reason: str) -> None:
        """Take the news that the link broke, and stands again; nobody has ended."""

    def let_go(self) -> None:
        """Let go of its tables: what it has left is about to be removed."""

    def lost(self, reason: str, *, orderly: bool) -> None:
        """Take the news that the RTPU process has ended."""


class RtpuLink:
    """One RTPU process.

    Args:
        places: Its files.
        config: What it is started with, unless it runs.
        listener: Who hears what it says.
    """

    def __init__(
        self, places: rundir.Places, config: wire.RtpuConfig, listener: Listener
    ) -> None:
        self._places = places
        self._config = config
        self._listener = listener
        self._process: subprocess.Popen[bytes] | None = None
        self._sock: socket.socket | None = None
        self._write_lock = threading.Lock()
        self._rest = memoryview(b"")
        """Of a frame that was begun; nothing else may be sent before it."""
        self._thread: threading.Thread | None = None
        self._closing = False
        self._decoder: msgspec.msgpack.Decoder[FromRtpu] = msgspec.msgpack.Decoder(
            FromRtpu
        )
        self.taken_over = False
        self.info: wire.RtpuInfo | None = None

    def open(self) -> wire.RtpuInfo:
        """Take over the RTPU process that runs, or start one.

        Raises:
            NodeError: It cannot be started, or is of another version or core.
        """
        self._sock = self._connect()
        self.taken_over = self._sock is not None
        if self._sock is None:
            cleaned = leftovers.clean_after(self._places)
            self._start()
            self._sock = self._connect()
            if self._sock is None:
                raise NodeError(
                    "the RTPU process does not answer",
                    where=self._config.name,
                    remedy="start the agent again; --debug shows what it wrote",
                    debug=self._log(),
                )
        else:
            cleaned = []
        info = self._attach(self._sock)
        self.info = info
        self._listener.informed(info)
        self._thread = threading.Thread(
            target=self._live, args=(self._sock,), name="pbonet rtpu link", daemon=True
        )
        self._thread.start()
        for text in cleaned:
            self.send(wire.Note(30, "CLEANED", text))
        return info

    def send(self, message: msgspec.Struct) -> None:
        """Send a message.

        Raises:
            NodeError: The RTPU process has ended, or takes nothing.
        """
        data = memoryview(wire.frame(message))
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
        """Send the rest of a frame that was begun, however long that takes."""
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
        """Have everything turned OFF in order; return whether it ended by itself."""
        self._closing = True
        with contextlib.suppress(NodeError):
            self.send(wire.Shutdown(timeout))
        by_itself = self._wait_for_end(timeout + 3.0)
        self.close()
        return by_itself

    def close(self) -> None:
        """Let go of the RTPU process, which goes on for its grace."""
        self._closing = True
        sock = self._sock
        if sock is not None:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)  # the thread that reads closes it
            if self._thread is None:
                sock.close()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def leave(self, grace: float) -> None:
        """Let go of it, for an agent that comes within the grace or so many seconds."""
        longer = max(grace, self._config.grace)
        with contextlib.suppress(NodeError):
            self.send(wire.Attach(os.getpid(), pbonet.__version__, longer))
        self.close()

    def _wait_for_end(self, timeout: float) -> bool:
        """Wait for the process's end; kill it when it takes longer."""
        if self.info is None:
            return True
        ended = self._ended(timeout, kill=True)
        self._reap()
        leftovers.clean_after(self._places)  # nothing, if it ended in order
        return ended

    def _reap(self) -> int | None:
        if self._process is None:
            return None
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(5.0)
        return None

    def _connect(self) -> socket.socket | None:
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

    def _attach(self, sock: socket.socket) -> wire.RtpuInfo:
        """Be its agent.

        Raises:
            NodeError: It has another one, or is of another version or core.
            OSError: It does not answer.
        """
        hello = wire.Attach(os.getpid(), pbonet.__version__, self._config.grace)
        sock.sendall(wire.frame(hello))
        data = wire.receive_frame(sock)
        if not data:
            raise NodeError(
                "the RTPU process of that name has another agent",
                where=self._config.name,
                remedy="choose another name",
            )
        info = self._decoder.decode(data)
        if not isinstance(info, wire.RtpuInfo):
            raise ProtocolError(
                "the RTPU process does not say who it is",
                remedy="end it, and start the agent again",
            )
        for what, got, wanted in (
            ("version", info.version, pbonet.__version__),
            ("core", info.core, self._config.core),
        ):
            if got != wanted:
                sock.close()
                raise NodeError(
                    f"the RTPU process that runs is of another {what}",
                    where=f"{self._config.name}, process {info.pid}",
                    expected=f"{what} {wanted}",
                    got=f"{what} {got}",
                    remedy=f"end it with `kill {info.pid}`, which turns its tasks OFF",
                )
        return info

    def _start(self) -> None:
        read, write = os.pipe()
        config = msgspec.structs.replace(self._config, ready_fd=write)
        command = [sys.executable, "-P", "-m", "pbonet.node.rtpu"]
        try:
            with self._places.log.open("wb") as log:
                self._process = subprocess.Popen(
                    [*command, msgspec.json.encode(config).decode()],
                    env=runtime.environment(),
                    pass_fds=[write],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
        finally:
            os.close(write)
        try:
            self._wait_until_ready(read)
        finally:
            os.close(read)

    def _wait_until_ready(self, read: int) -> None:
        """Wait for the one message that says how the start went.

        Raises:
            PbonetError: What kept it from starting.
        """
        deadline = time.monotonic() + START_TIME
        data = b""
        while select.select([read], [], [], max(deadline - time.monotonic(), 0))[0]:
            part = os.read(read, 65536)
            if not part:
                break
            data += part
        process = self._process
        if data:
            ready = msgspec.msgpack.decode(data, type=wire.Ready)
            if ready.error is None:
                return
            self._reap()
            error = PbonetError.from_wire(ready.error)
            error.debug = error.debug or self._log()
            raise error
        if process is not None:
            process.kill()
            code = process.wait()
            raise NodeError(
                "the RTPU process did not start",
                got=f"exit code {code}",
                debug=self._log(),
                remedy="--debug shows what it wrote",
            )

    def _log(self) -> str:
        """Return the end of what the RTPU process wrote."""
        with contextlib.suppress(OSError):
            return self._places.log.read_text(errors="replace")[-LOG_TAIL:].strip()
        return ""

    def _live(self, sock: socket.socket) -> None:
        """Hear the RTPU process until it ends; a link that breaks is made anew."""
        while True:
            reason, orderly = self._read(sock)
            with self._write_lock:
                self._sock, self._rest = None, memoryview(b"")
                sock.close()
            again = None if orderly else self._again(reason)
            if again is None:
                break
            sock = again
        if self._closing:
            return
        with _contained():
            self._listener.let_go()
        how = self._describe_end(reason, orderly=orderly)
        with _contained():
            self._listener.lost(how, orderly=orderly)

    def _read(self, sock: socket.socket) -> tuple[str, bool]:
        """Hand on what comes; return why nothing comes any more, and if in order."""
        while True:
            try:
                data = wire.receive_frame(sock)
                if not data:
                    return "its socket was closed", False
                message = self._decoder.decode(data)
            except (OSError, NodeError, msgspec.MsgspecError) as error:
                return str(error), False
            if isinstance(message, wire.Ending):
                return message.reason, True
            with _contained():
                self._hand_over(message)

    def _again(self, reason: str) -> socket.socket | None:
        """Attach again if the process lives on; return the socket.

        On a machine that stood still meanwhile it is tried more than once, too.
        """
        deadline = time.monotonic() + AGAIN_TIME
        tries = 0
        while not (self._closing or self._ended(_LOOK)):
            if tries >= _LEAST_TRIES and time.monotonic() > deadline:
                return None
            tries += 1
            sock = self._connect()
            if sock is None:
                continue
            try:
                sock.settimeout(AGAIN_TIME)
                info = self._attach(sock)
                sock.settimeout(None)
            except (OSError, NodeError, msgspec.MsgspecError):
                sock.close()  # it has not noticed yet, or it ends
                continue
            log.warning("%s: the link broke: %s", self._config.name, reason)
            with _contained():
                self._listener.broke(reason)
            if not self._use(sock):
                return None
            with _contained():
                self._hand_over(info)
            return sock
        return None

    def _use(self, sock: socket.socket) -> bool:
        """Send there from now on, unless the link is being closed."""
        with self._write_lock:
            self._sock = sock
        if self._closing:  # by who saw no socket to shut down
            with self._write_lock:
                self._sock = None
                sock.close()
        return not self._closing

    def _ended(self, timeout: float, *, kill: bool = False) -> bool:
        """Return whether the process ended in time; with `kill`, end it if not."""
        if self.info is None:
            return True
        try:
            pidfd = os.pidfd_open(self.info.pid)
        except ProcessLookupError:
            return True
        try:
            ended = bool(select.select([pidfd], [], [], timeout)[0])
            if kill and not ended:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
                select.select([pidfd], [], [], 5.0)
        finally:
            os.close(pidfd)
        return ended

    def _hand_over(self, message: FromRtpu) -> None:
        match message:
            case wire.Answered():
                self._listener.answered(message.n, message.data)
            case wire.Published():
                self._listener.published(message.data)
            case wire.RtpuInfo():
                self.info = message
                self._listener.informed(message)
            case Known():
                self._listener.learned(message)
            case wire.Ending():
                pass

    def _describe_end(self, reason: str, *, orderly: bool) -> str:
        """Return how the process ended, with the end of its log if not in order."""
        self._wait_for_end(5.0 if orderly else 1.0)
        if orderly:
            return reason
        from .tasks import describe_end

        code = self._process.returncode if self._process else None
        how = describe_end(code) if code is not None else reason
        log = self._log()
        return f"{how}\n{log}" if log else how


def _send(sock: socket.socket, data: memoryview, flags: int = 0) -> memoryview:
    """Send until nothing is taken any more; return what is left."""
    with contextlib.suppress(BlockingIOError):
        while data:
            data = data[sock.send(data, flags) :]
    return data


@contextlib.contextmanager
def _contained() -> Generator[None]:
    """Tell a listener something in this block; the link outlives what it raises."""
    try:
        yield
    except Exception:
        log.exception("what the RTPU process said could not be taken")


def used_cores(folder: Path) -> Sequence[int]:
    """Return the cores that RTPU processes of this machine use, with repetitions."""
    states = (leftovers.read(path) for path in folder.glob("*/*.state"))
    return [state.core for state in states if state is not None and state.alive]


def choose_core(folder: Path) -> int:
    """Return the core for an RTPU that names none: a free one, the last ones first.

    The first core is left to everything else, unless it is the only one.
    """
    allowed = sorted(os.sched_getaffinity(0))
    candidates = allowed[1:] or allowed
    used = used_cores(folder)
    return min(candidates, key=lambda core: (used.count(core), -core))
