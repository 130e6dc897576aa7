"""The RTPUs of a subsystem in virtual time: no processes, no network, no devices.

Each is the RTPU of `pbonet.node` in this process, and answers every request that its
agent would answer. So a program that controls a `Subsystem` runs unchanged in virtual
time, and comes to the same result each time. What only time itself can do to tasks is
not there: nothing is late, nothing hangs, no execution time is measured.
"""

from __future__ import annotations

import itertools
import math
import os
import platform
import threading
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from pbonet.analysis.schedule import CoreShare
from pbonet.errors import PbonetError, StateError
from pbonet.io import no_devices
from pbonet.node.agent import HANDLED
from pbonet.node.task import placed
from pbonet.node.wire import EventLog
from pbonet.pbo import Signal
from pbonet.versions import LAYERS
from pbonet.xm.net import Codec, event_codes, failure, machine, messages as m, rpc

from .rtpu_in_process import SharedState, VirtualRtpu
from .sim_recording import Recording
from .virtual_loop import BEGIN_NS, make_loop, running

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping
    from threading import Event

    from pbonet.log import TaskAbout
    from pbonet.master.configuration import Files

    from .rtpu_in_process import VirtualTask
    from .sim_log import SimLog

T = TypeVar("T")

HOST = "virtual"
"""The name of the machine that is none."""
REASON = "this is a simulation"
_NUMBERS = itertools.count(1)
_REPORTED = frozenset({"WARNING", "SIGNAL", "HANDLED", "METHOD", "FALLBACK"})
"""Codes of events that are reported as text."""


class VirtualRtpus:
    """The RTPUs of a subsystem, answering as their agents would.

    At one instant they have their turn in the order of the ``.sbs`` file, and on each
    the more urgent task first. A cycle takes no time. They are the clock of their
    master too: time passes only where it waits, as fast as modules can run.

    Args:
        files: The subsystem's files.

    Attributes:
        recording: Every cycle so far, unless there is a log.
        events: What tasks have reported and what went wrong in them, one text each.
    """

    def __init__(self, files: Files) -> None:
        self.log: SimLog | None = None
        """Where it is recorded; without, every cycle is kept in memory."""
        about = {"subsystem": files.sbs.subsystem, "mode": "simulation"}
        if (first := files.job or files.seq) is not None:
            about |= {"job": first.name, "file": first.file}
        self.recording = Recording(about)
        self.events: list[str] = []
        self.told: list[Callable[[], None]] = []
        """Called whenever something happens."""
        self.epoch_ns = 0
        """Offset from virtual time to nanoseconds since 1970."""
        self._lock = threading.RLock()
        self._codec = Codec()
        self._loop = make_loop(BEGIN_NS)
        domain = f"virtual{os.getpid()}-{next(_NUMBERS)}"
        self.world = SharedState(self._loop, files.library, domain, self._record)
        self.logs = {one.name: self._event_log(one.name) for one in files.sbs.rtpus}
        with running(self._loop):
            self.rtpus = {
                name: VirtualRtpu(name, number, self.world, log)
                for number, (name, log) in enumerate(self.logs.items())
            }
        for one in self.logs.values():
            one.publish = self._published

    def _event_log(self, rtpu: str) -> EventLog:
        return EventLog(
            rtpu,
            clock_ns=lambda: self.now_ns,
            wall=lambda: (self.now_ns + self.epoch_ns) * 1e-9,
        )

    @property
    def now_ns(self) -> int:
        """The virtual time."""
        return self._loop.now_ns

    def client(
        self, domain: str, name: str, warned: Callable[[str, str], None]
    ) -> rpc.Client:
        """Return a client that asks these RTPUs instead of agents; see `rpc.Client`."""
        return VirtualClient(self, domain, name, warned=warned)

    def close(self) -> None:
        """Free the memory of tables; the recording remains."""
        for core in self.world.cores:
            core.end()
        for table in self.world.tables.values():
            table.close()

    # -- requests ----------------------------------------------------------------------

    def answer(self, rtpu: str, request: m.Request) -> m.Answer:
        """Carry out a request; time passes if it waits for that."""
        with self._lock, no_devices(REASON):
            try:
                data = self._codec.pack(request)
                return self._codec.answer(self._packed(self.rtpus[rtpu], request, data))
            except PbonetError as error:
                return failure(error, request.id)

    def _packed(self, rtpu: VirtualRtpu, request: m.Request, data: bytes) -> bytes:
        """Return the packed answer of an RTPU or of its substitute agent."""
        if isinstance(request, m.Hello):
            info = _info(rtpu)
            return self._codec.pack(
                m.Answer(v=request.v, id=request.id, ok=True, result=info)
            )
        if isinstance(request, m.TraceCore):
            raise StateError(
                "a simulation has no core that could be followed",
                where=rtpu.name,
                remedy="run the tasks in real time",
            )
        if isinstance(request, m.Profile):
            raise StateError(
                "a simulation measures no execution times",
                where=rtpu.name,
                remedy="run the tasks in real time to measure them",
            )
        if isinstance(request, HANDLED):
            rtpu.overview.refresh()
            return rtpu.overview.answer(request)
        answer = self._until_done(rtpu.operations.handle(data))
        if isinstance(request, m.Claim):
            rtpu.overview.refresh()
            return rtpu.overview.with_status(request, answer, _info(rtpu))
        return answer

    def _until_done(self, asked: Coroutine[Any, Any, bytes]) -> bytes:
        """Run a coroutine to its end, and let time pass while it waits."""
        done = self._loop.create_task(asked)
        self._loop.run()
        while not done.done():
            self.step(math.inf)
        return done.result()

    # -- time --------------------------------------------------------------------------

    def now(self) -> float:
        """Return the virtual seconds."""
        return self.now_ns * 1e-9

    def wait(self, seconds: float, until: Event) -> bool:
        """Let time pass until it is over or an event is set; return whether it is."""
        # A rest below half a nanosecond passes too, else its waiter never comes to 0.
        end_ns = self.now_ns + max(round(seconds * 1e9), seconds > 0)
        while not until.is_set():
            with self._lock, no_devices(REASON):
                if not self.step(end_ns):
                    break
        if self.log is not None:
            self.log.turn(self.now_ns)
        return until.is_set()

    def step(self, end_ns: float) -> bool:
        """Go on to the next instant at which something is due, at most to an end.

        Returns:
            Whether it was before the end.
        """
        self._loop.run()
        wanted = [self._loop.due_ns, *(one.core.due_ns for one in self.rtpus.values())]
        due = min(filter(None, wanted), default=math.inf)
        if due > end_ns:
            self.set_time(int(end_ns))
            return False
        self.set_time(max(self.now_ns, int(due)))
        self._loop.run()
        for rtpu in self.rtpus.values():
            if 0 < rtpu.core.due_ns <= self.now_ns:
                rtpu.turn()
        return True

    def set_time(self, now_ns: int) -> None:
        """Set the virtual time, and run nothing."""
        self._loop.now_ns = now_ns
        for rtpu in self.rtpus.values():
            rtpu.core.virtual_ns = now_ns

    # -- what happens ------------------------------------------------------------------

    def _published(self, event: m.Event) -> None:
        if self.log is not None:
            self.log.event(event)
        if event.code in _REPORTED and not event.bits & Signal.ERROR:
            end = event_codes.failure_text("", event.state)
            text = placed(event.text.removesuffix(end), event.place)
            at = (event.time - BEGIN_NS) * 1e-9
            self.events.append(f"{at:.3f} s {event.task}: {text}")
        for told in self.told:
            told()

    def _record(self, host: VirtualTask, about: TaskAbout) -> None:
        """Have the cycles of a task kept, in memory or in the log."""
        if self.log is not None:
            self.log.follow(host, about)
        else:
            record = self.recording.task(about.task, about)
            host.drain = lambda: record.add(host.ring.take())
            record.drain = lambda: host.drain()  # noqa: PLW0108 - what it is by then


def _info(rtpu: VirtualRtpu) -> m.AgentInfo:
    return m.AgentInfo(
        name=rtpu.name,
        domain=HOST,
        host=HOST,
        machine=machine(),
        core=0,
        cores=1,
        pid=os.getpid(),
        rtpu_pid=0,
        backend="inline",
        share=CoreShare().share,
        share_reason=CoreShare().reason,
        version="",
        versions=LAYERS,
        python=platform.python_version(),
    )


class _Heard:
    """A function that is called until this is undeclared."""

    def __init__(self, told: list[Callable[[], None]], one: Callable[[], None]) -> None:
        self._take_back = partial(told.remove, one)
        told.append(one)

    def undeclare(self) -> None:
        """Call it no more."""
        self._take_back()


class VirtualClient(rpc.Client):
    """Asks virtual RTPUs in place of agents.

    Args:
        rtpus: Who answers.
        domain: The domain's name, for keys, which no other process sees.
        name: The master's own name.
        warned: As for `rpc.Client`.
    """

    def __init__(
        self,
        rtpus: VirtualRtpus,
        domain: str,
        name: str,
        *,
        warned: Callable[[str, str], None] = rpc.log_warning,
    ) -> None:
        super().__init__(None, domain, name, warned=warned)  # type: ignore[arg-type]
        self._rtpus = rtpus

    def tokens(self, key: str) -> list[str]:
        """Return nothing: there is no other master."""
        del key
        return []

    def rtpus(self) -> list[str]:
        """Return the names of the RTPUs, sorted."""
        return sorted(self._rtpus.rtpus)

    def call_all(
        self,
        requests: Mapping[str, m.Request],
        result: type[T],
        *,
        timeout: float = rpc.ANSWER_TIME,
    ) -> tuple[dict[str, T], list[PbonetError]]:
        """Send a request to each of several RTPUs, in the same order each time."""
        results: dict[str, T] = {}
        errors: list[PbonetError] = []
        for rtpu, request in requests.items():
            try:
                results[rtpu] = self.call(rtpu, request, result, timeout=timeout)
            except PbonetError as error:
                errors.append(error)
        return results, errors

    def announce(self, key: str) -> rpc.Declared:
        """Show nothing."""
        del key
        return _Heard([], lambda: None)

    def subscribe(self, key: str, told: Callable[[], None]) -> rpc.Declared:
        """Have a function called whenever something happens."""
        del key
        return _Heard(self._rtpus.told, told)

    def close(self) -> None:
        """Do nothing: there is no connection."""

    def _exchange(self, rtpu: str, request: m.Request, timeout: float) -> m.Answer:
        del timeout
        return self._rtpus.answer(rtpu, request)
