"""The agent's recorders: one process for each recorded subsystem."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from pbonet.config import agent_text
from pbonet.errors import Severity
from pbonet.node.rtpu import orphaned_rings
from pbonet.node.wire import command, describe_end, process_setup, rtpu_messages

from .recorder_pipe import RecorderPipe

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping
    from typing import BinaryIO

    from pbonet.config import AgentConfig
    from pbonet.xm.net import AnyRequest

    Tell = Callable[[rtpu_messages.FromRecorder], None]
    _Told = Callable[[], rtpu_messages.Commanded]

END_TIME: Final = 10.0
"""Seconds in which a recorder must finish its log."""
IDLE_TIME: Final = 1.0
"""Seconds for which an ending recorder may do nothing but wait for a disk."""
RESTARTS: Final = 5
BEFORE: Final = 32
"""Number of commands kept of a subsystem that is not recorded yet."""
AGAIN_TIME: Final = 1.0
"""Seconds between attempts to start a recorder while the system has no resources."""
_PAUSE: Final = 0.01
WINDOW: Final = 60.0
"""A recorder that is lost more often than this many times in so many seconds is not
started again."""


class _Child:
    """One recorder's process.

    Args:
        wanted: The plan of the recording.
        before: Commands answered earlier.
        tell: Called with its messages.
    """

    def __init__(
        self,
        wanted: rtpu_messages.Recording,
        before: Iterable[rtpu_messages.Commanded],
        send: Callable[[rtpu_messages.FromRecorder], None],
    ) -> None:
        self.wanted = wanted
        self._tell = send
        self._guard = threading.Lock()
        self._ending = threading.Event()
        self._lost: list[float] = []
        self._handed_on = wanted.lost
        """Records that its recorders have lost of each task, for the next one."""
        self._said = -1
        self._feed = RecorderPipe(self._unfit, self._kill)
        self._process = self._start(before)
        self._thread = threading.Thread(
            target=self._listen, name="pbonet recorder", daemon=True
        )
        self._thread.start()

    def _start(
        self, before: Iterable[rtpu_messages.Commanded]
    ) -> subprocess.Popen[bytes]:
        """Start a process, with its plan in a memory file and two pipes.

        Raises:
            OSError: The system has no process or no descriptors for it.
        """
        recording = msgspec.structs.replace(
            self.wanted, before=list(before), lost=self._handed_on
        )
        with contextlib.ExitStack() as ours, contextlib.ExitStack() as its:
            wanted = os.memfd_create("recording")
            its.callback(os.close, wanted)
            os.write(wanted, rtpu_messages.encode(recording))
            events, feed = os.pipe()
            its.callback(os.close, events)
            ours.callback(os.close, feed)
            self._said, said = os.pipe()
            ours.callback(os.close, self._said)
            its.callback(os.close, said)
            process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-m",
                    "pbonet.node.recorder.recorder_process",
                    str(wanted),
                ],
                env=process_setup.environment(),
                stdin=events,
                stdout=said,
                pass_fds=[wanted],
                start_new_session=True,
            )
            ours.pop_all()
        self._feed.begin(feed)
        return process

    def records(self, wanted: rtpu_messages.Recording | None) -> bool:
        """Return whether it has this plan; what was lost meanwhile is no part of it."""
        return wanted is not None and self.wanted == msgspec.structs.replace(
            wanted, lost=self.wanted.lost
        )

    @property
    def pid(self) -> int:
        """The process that records now."""
        return self._process.pid

    def send(self, message: rtpu_messages.ToRecorder) -> None:
        """Send a message; a recorder that does not read is restarted."""
        self._feed.put(rtpu_messages.frame(message))

    def _kill(self) -> None:
        self._process.kill()

    def _unfit(self, count: int) -> None:
        text = f"{count} events and commands of {self.wanted.subsystem} came faster "
        text += "than its recorder took them; they are not in the log"
        self._tell(rtpu_messages.Note(int(Severity.WARNING), "NOT_RECORDED", text))

    def end(self) -> None:
        """Let the recorder finish its log; `join` waits for that."""
        with self._guard:
            self._ending.set()
            self._feed.end()

    def join(self) -> None:
        """Wait for the end; a recorder that stands still or takes long is killed."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGCONT)  # it may be stopped
        deadline = time.monotonic() + END_TIME
        idle = process_setup.Idle(self._process.pid)
        while self._process.poll() is None:
            if time.monotonic() > deadline or idle.seconds() > IDLE_TIME:
                self._process.kill()
            time.sleep(_PAUSE)
        self._thread.join()

    def _listen(self) -> None:
        again = True
        while again:
            with os.fdopen(self._said, "rb") as said:
                self._read_output(said)
            again = self._again(self._process.wait())

    def _read_output(self, said: BinaryIO) -> None:
        decoder = msgspec.msgpack.Decoder(rtpu_messages.FromRecorder)
        head = rtpu_messages.LENGTH.size
        while len(data := said.read(head)) == head:
            (size,) = rtpu_messages.LENGTH.unpack(data)
            with contextlib.suppress(msgspec.MsgspecError):
                message = decoder.decode(said.read(size))
                if isinstance(message, rtpu_messages.Recorder):
                    self._handed_on = message.handed_on
                self._tell(message)

    def _again(self, code: int) -> bool:
        """Restart a recorder that was lost; return whether it was restarted."""
        with self._guard:
            if self._ending.is_set():
                return False
            self._feed.leave()
        now = time.monotonic()
        self._lost = [t for t in self._lost if now - t < WINDOW] + [now]
        again = len(self._lost) <= RESTARTS
        what = "another one continues" if again else "recording has stopped"
        self._died(f"ended: {describe_end(code)}; {what}")
        self._tell(rtpu_messages.Recorder(subsystem=self.wanted.subsystem))
        if again and self._started_again():
            return True
        with self._guard:
            self._feed.end()
        return False

    def _started_again(self) -> bool:
        """Start another one as soon as the system allows; False if it must end."""
        told = False
        while True:
            with self._guard:
                if self._ending.is_set():
                    return False
                try:
                    self._process = self._start(())
                except OSError as error:
                    refused = str(error)
                else:
                    return True
            if not told:
                self._died(f"could not be started again: {refused}; it is tried again")
            told = True
            self._ending.wait(AGAIN_TIME)

    def _died(self, how: str) -> None:
        text = f"the recorder of {self.wanted.subsystem} {how}"
        self._tell(rtpu_messages.Note(int(Severity.ERROR), "RECORDER_DIED", text))


class Recorders:
    """Runs a recorder for each recorded subsystem.

    Args:
        send: Passes a note to the RTPU process, or what a recorder has lost.
        config: The machine's configuration; each log contains it.
    """

    def __init__(self, send: Tell, config: AgentConfig) -> None:
        self._tell = send
        self._limits = rtpu_messages.LogLimits(
            config.log_mb, config.log_minutes, config.runs_mb
        )
        self._text = agent_text(config)
        self._domain, self._name = config.domain, config.name
        self._fares: dict[str, rtpu_messages.Recorder] = {}
        self._children: dict[str, _Child] = {}
        self._ended: list[_Child] = []
        self._before: dict[str, deque[_Told]] = {}
        """Commands to subsystems that are not recorded yet."""
        self._claims: set[str] = set()
        self._guard = threading.Lock()

    def update(
        self,
        wanted: Mapping[str, rtpu_messages.Recording],
        claims: Collection[str] = (),
    ) -> None:
        """Start and end recorders so that exactly these subsystems are recorded.

        Args:
            wanted: Plans of the recordings, by subsystem.
            claims: Subsystems that hold a claim; commands are kept only of these.
        """
        wanted = {
            name: msgspec.structs.replace(
                one, limits=self._limits, files={**one.files, "agent.toml": self._text}
            )
            for name, one in wanted.items()
        }
        with self._guard:
            for subsystem, child in list(self._children.items()):
                if not child.records(wanted.get(subsystem)):
                    del self._children[subsystem]
                    self._fares.pop(subsystem, None)
                    child.end()
                    self._ended.append(child)
            for subsystem, one in wanted.items():
                if subsystem not in self._children:
                    self._begin(subsystem, one)
            self._claims = set(claims)
            for subsystem in self._before.keys() - self._claims:
                del self._before[subsystem]

    def _begin(self, subsystem: str, wanted: rtpu_messages.Recording) -> None:
        """Start a recorder; if that fails, the next update tries again."""
        before = [told() for told in self._before.get(subsystem, ())]
        try:
            self._children[subsystem] = _Child(wanted, before, self._said)
        except OSError as error:
            text = f"the recorder of {subsystem} could not be started: {error}"
            text += "; nothing is recorded: request it again"
            self._tell(rtpu_messages.Note(int(Severity.ERROR), "RECORDER_DIED", text))
        else:
            self._before.pop(subsystem, None)

    def fares(self, subsystem: str) -> rtpu_messages.Recorder | None:
        """Return the state of a subsystem's recorder; None if there is none."""
        return self._fares.get(subsystem)

    def _said(self, message: rtpu_messages.FromRecorder) -> None:
        if isinstance(message, rtpu_messages.Recorder):
            self._fares[message.subsystem] = message
            if not message.handed_on:
                return
        self._tell(message)

    def processes(self) -> dict[int, str]:
        """Return the processes of the recorders, with what each one is."""
        with self._guard:
            children = dict(self._children)
        return {c.pid: f"the recorder of {name}" for name, c in children.items()}

    def send(self, message: rtpu_messages.ToRecorder) -> None:
        """Send a message to all recorders."""
        with self._guard:
            children = list(self._children.values())
        for child in children:
            child.send(message)

    def commanded(
        self, request: AnyRequest, answer: bytes, begun_ns: int, ended_ns: int
    ) -> None:
        """Record a command, or keep it until its subsystem is recorded."""
        if not request.subsystem:
            return
        told = command(request, answer, begun_ns, ended_ns)
        with self._guard:
            child = self._children.get(told.subsystem)
            if child is None:
                self._keep(told.subsystem, lambda: told)
        if child is not None:
            child.send(told)

    def noted(
        self, request: AnyRequest, answer: bytes, begun_ns: int, ended_ns: int
    ) -> bool:
        """Keep a short command; return False if `commanded` must be called instead.

        This takes almost no time: the record of a command is made only if a recording
        begins.
        """
        if not self._guard.acquire(blocking=False):
            return False
        try:
            if request.subsystem in self._children:
                return False
            told = partial(command, request, answer, begun_ns, ended_ns)
            self._keep(request.subsystem, told)
            return True
        finally:
            self._guard.release()

    def _keep(self, subsystem: str, told: _Told) -> None:
        if subsystem in self._claims:
            room: deque[_Told] = deque(maxlen=BEFORE)
            self._before.setdefault(subsystem, room).append(told)

    def stop(self, *, sweep: bool = True) -> None:
        """Finish all logs.

        Args:
            sweep: Remove the rings that no recorder took; otherwise the RTPU process
                continues, and they remain for the next agent's recorders.
        """
        self.update({})
        with self._guard:
            ended, self._ended = self._ended, []
        for child in ended:
            child.join()
        if sweep and self._name is not None:
            orphaned_rings.sweep(self._domain, self._name)
