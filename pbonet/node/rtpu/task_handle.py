"""One task as the RTPU process holds it: its process, its socket, what is known of it.

Nothing here decides what a signal means or when a task may get one; that is the work
of `request_handlers`. This is the link: one message at a time, its answer within
a time limit, and a certain notification of its end.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import re
import signal
import time
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import (
    MethodError,
    NoAnswerError,
    PbonetError,
    Severity,
    StateError,
    TaskDiedError,
    TaskError,
)
from pbonet.node.task import Lines
from pbonet.node.wire import LineBudget, describe_end, rtpu_messages
from pbonet.pbo import State
from pbonet.xm.net import codec

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Callable

    from pbonet.config import Rmod
    from pbonet.node import rt
    from pbonet.xm.net import Call, Restart, TaskStatus

    from .fork_client import Child

    Make = Callable[[int], rtpu_messages.ToTask]

END_TIME = 1.0
"""Seconds that a task which said good-bye may take to end."""
_SLICE = 0.1
"""Seconds of a wait that a standstill of the machine may cost."""
_DUMP_TIME = 0.1
_LOOK = 0.02
"""Seconds after which it is looked again whether a task waits for its core."""
_MUCH_WAITED = 0.1
"""Of the time limit, what a wait for the core must take to be named."""


class Facts(msgspec.Struct, kw_only=True):
    """The configuration of a task; does not change while it lives."""

    subsystem: str
    name: str
    rmod: Rmod
    text: str
    """The RMOD's text, for masters that come later."""
    slot: int
    ring: str
    restart: Restart = "off"
    """As in `Spawn`; its agent acts on it."""

    @property
    def outputs(self) -> list[str]:
        """The variables that the task writes in its cycles."""
        return [self.rmod.svar_name(port) for port in self.rmod.outvar]


class Waiting(msgspec.Struct):
    """The wait of a successor; see `successors`."""

    after: list[str]
    """Its predecessors, on any RTPU, which call it."""
    calls: list[Call]
    """One for each of them."""
    timer: asyncio.TimerHandle


class Task:
    """A task that was forked.

    Args:
        facts: What it was made from.
        child: Its process.
        wake: Notifies the task, through its slot, that a message waits; optionally that
            it must be read after the next cycle.
        tell: Takes what the task reports unasked, and what it prints.
        changed: Called when the task has said anything, or has ended.
        ended: Called once, with the exit code, when the process is gone.
    """

    def __init__(
        self,
        facts: Facts,
        child: Child,
        *,
        wake: Callable[[bool], None],
        tell: Callable[[Task, rtpu_messages.Notice], None],
        changed: Callable[[], None],
        ended: Callable[[Task, int], None],
    ) -> None:
        self.facts = facts
        self.child = child
        self.state = State.NOT_CREATED
        self.ready: rtpu_messages.TaskReady | None = None
        self.freq = facts.rmod.freq or 0.0
        self.on_rank = 0
        """Counts up over all tasks as they are turned on; OFF goes the other way."""
        self.warnings = 0
        self.warning = ""
        self.error = ""
        self.blame = ""
        """Why the RTPU process has ended it, if it did."""
        self.waits = ""
        """How long its cycles wait for something other than the core."""
        self.ending = ""
        """How its process ended, once that is known."""
        self.left = False
        """It was ON and turned itself off, which was not requested."""
        self.last_status: TaskStatus | None = None
        """Its status as it ended."""
        self.stands_by = ""
        """The task that this one is the fallback of, while it stands by for it."""
        self.waiting: Waiting | None = None
        """Its predecessors, while it stands by for them or has not been asked for."""
        self.engaged: asyncio.Future[rtpu_messages.Notice] | None = None
        """Resolves when the dispatcher has engaged the task and its `on` has run."""
        self.stopping = False
        """True once its end is wanted, so that the end is no event."""
        self.budget = LineBudget(rate=50.0, burst=200.0)
        """How many notices of the module become events."""
        self.coming: list[asyncio.Event] = []
        """Set when requests to turn it on that are being carried out are done."""
        self.orders: dict[str, deque[str]] = {}
        """Signals of its module that wait or are carried out, by the other task."""
        self.gone = asyncio.Event()
        self._lock = asyncio.Lock()
        self._wake = wake
        self._tell = tell
        self._changed = changed
        self._ended = ended
        self._count = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[rtpu_messages.Done]] = {}
        self._busy = {0: "init"}
        self._decoder: msgspec.msgpack.Decoder[rtpu_messages.FromTask] = (
            msgspec.msgpack.Decoder(rtpu_messages.FromTask)
        )
        self.spawned = self._expect(0)
        self._lines = Lines(self._printed, time.monotonic_ns)
        asyncio.get_running_loop().add_reader(child.out, self._read_output)
        self._life = asyncio.create_task(self._live(), name=f"task {facts.name}")

    @property
    def name(self) -> str:
        """The task's name in its subsystem."""
        return self.facts.name

    @property
    def signals(self) -> dict[str, int]:
        """Names and bits of the module's own signals, as far as it is known."""
        return self.ready.signals if self.ready else {}

    @property
    def busy(self) -> str:
        """The task's current command; empty when it waits for a message."""
        return next(iter(self._busy.values()), "")

    async def command(
        self,
        what: str,
        make: Make,
        limit: float,
        *,
        last: bool = False,
        extra: float = 0.0,
    ) -> rtpu_messages.Done:
        """Send one message and return the answer.

        Args:
            what: What is asked, for messages: ``on``, ``set``.
            make: Makes the message from its number.
            limit: Seconds to wait for the answer, and before that for those who asked
                earlier.
            last: It is carried out after the task's next cycle, at the cycle's level.
            extra: As in `wait_for`.

        Raises:
            StateError: The task is still carrying out an earlier message; nothing was
                sent.
            NoAnswerError: It did not answer in time, and may do so later.
            TaskDiedError: It ended.
            PbonetError: What the task answered.
        """
        left = await self._turn(limit)
        try:
            answer = self._ask(what, make, last=last)
            return await self.wait_for(answer, what, left, of=limit, extra=extra)
        finally:
            self._lock.release()

    def _ask(
        self, what: str, make: Make, *, last: bool
    ) -> asyncio.Future[rtpu_messages.Done]:
        """Send a message; return what resolves with the answer.

        Raises:
            PbonetError: It could not be sent.
        """
        n = next(self._count)
        answer = self._expect(n)
        self._busy[n] = what
        try:
            self.send(make(n), last=last)
        except PbonetError:  # it was never asked
            self._busy.pop(n, None)
            self._waiting.pop(n, None)
            raise
        return answer

    async def _turn(self, limit: float) -> float:
        """Take the lock, within `limit` seconds; return how many are left.

        Raises:
            StateError: The task is still carrying out an earlier message.
        """
        begun = time.monotonic()
        try:
            async with asyncio.timeout(limit):
                await self._lock.acquire()
        except TimeoutError:
            raise self._still_busy() from None
        if self.busy:
            self._lock.release()
            raise self._still_busy()
        return max(limit - (time.monotonic() - begun), 0.0)

    def _still_busy(self) -> StateError:
        return StateError(
            f"the task is still busy with {self.busy!r}",
            where=self.name,
            remedy="wait for it, or `kill` the task",
        )

    async def wait_for(
        self,
        answer: asyncio.Future[rtpu_messages.Done],
        what: str,
        left: float,
        *,
        of: float | None = None,
        extra: float = 0.0,
    ) -> rtpu_messages.Done:
        """Return the answer to a message, or the reason why there is none.

        Args:
            answer: Resolves when it has come.
            what: What was asked, for messages.
            left: Seconds to wait.
            of: The seconds that were given, if earlier messages took some of them.
            extra: Seconds to wait longer, at most, if the task was ready for as long
                and did not get its core: then the machine is busy, and it does not
                hang.

        Raises:
            NoAnswerError: It did not come in time.
            TaskDiedError: The task ended.
            PbonetError: What the task answered.
        """
        clock = asyncio.get_running_loop().time
        begun, core_wait = clock(), self.child.core_wait()
        waited = 0.0
        remaining, look = left, _LOOK if extra and core_wait.known else math.inf
        while remaining > 0 and not answer.done():
            await asyncio.wait({answer}, timeout=min(remaining, look))
            if look == _LOOK and not answer.done():
                waited = min(core_wait.seconds(), extra)
            remaining = left + waited - (clock() - begun)
        if not answer.done():  # it may have come while this process did not run
            raise self._too_late(what, left if of is None else of, waited)
        done = answer.result()
        if done.error is not None:
            raise error_of(done)
        return done

    def _too_late(self, what: str, given: float, waited: float) -> NoAnswerError:
        text = f"the task did not finish {what!r} within "
        remedy = "wait for it, or `kill` the task"
        if waited < _MUCH_WAITED * given:
            return NoAnswerError(f"{text}{given:.3g} s", where=self.name, remedy=remedy)
        text += (
            f"{given + waited:.3g} s, of which it waited {waited:.3g} s for its core"
        )
        remedy += "; `pbonet top` and `top` show what else uses the core"
        return NoAnswerError(text, where=self.name, remedy=remedy)

    async def idle(self) -> None:
        """Wait until the task has answered everything, or has ended."""
        await asyncio.gather(*self._waiting.values(), return_exceptions=True)

    def send(self, message: rtpu_messages.ToTask, *, last: bool = False) -> None:
        """Pass a message to the task; it reads it after its present component."""
        data = rtpu_messages.encode(message)
        if len(data) > rtpu_messages.LARGEST_PACKET:
            raise TaskError(
                "the message is too long for a task",
                where=self.name,
                expected=f"at most {rtpu_messages.LARGEST_PACKET} bytes",
                got=f"{len(data)} bytes",
                remedy="give a shorter text or value",
            )
        try:
            self.child.sock.send(data)
            self.child.send_signal(signal.SIGCONT)  # it may be stopped
        except OSError as error:
            raise TaskDiedError(
                "the task takes no messages",
                where=self.name,
                got=str(error),
                remedy="'status' shows its state; kill it and spawn it again",
            ) from None
        self._wake(last)

    async def where(self) -> str:
        """Return the task's Python stack, as text; for tasks that hang."""
        self.child.send_signal(rtpu_messages.DUMP_SIGNAL)
        for _ in range(10):
            await asyncio.sleep(_DUMP_TIME / 10)
            if text := self.child.crash_text():
                return text
        return ""

    async def end(self, patience: float) -> bool:
        """Wait for the end, then force it; return whether it came by itself.

        In slices: if the whole machine stands still, for us as for the task, that is
        one slice, and not the task's delay.
        """
        self.stopping = True
        for _ in range(max(1, math.ceil(patience / _SLICE))):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(min(_SLICE, max(patience, 0.0))):
                    await self.gone.wait()
                return True
        self.child.send_signal(signal.SIGKILL)
        await self.gone.wait()
        return False

    def _expect(self, n: int) -> asyncio.Future[rtpu_messages.Done]:
        answer: asyncio.Future[rtpu_messages.Done] = (
            asyncio.get_running_loop().create_future()
        )
        self._waiting[n] = answer
        return answer

    async def _live(self) -> None:
        """Read what the task sends until it ends; then clean up after it."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                data = await loop.sock_recv(
                    self.child.sock, 2 * rtpu_messages.LARGEST_PACKET
                )
            except OSError:
                break
            if not data:
                break
            self._take(data)
            self._changed()
        code = await self.child.exited
        loop.remove_reader(self.child.out)
        self._read_output()
        self._lines.close()
        self.state = State.NOT_CREATED
        try:
            self._ended(self, code)
        finally:
            self._bury(code)
            self._changed()

    def _bury(self, code: int) -> None:
        """Notify all waiters that the task is gone, and close its files."""
        for answer in self._waiting.values():
            if not answer.done():
                answer.set_exception(self.death(code))
                answer.exception()  # there may be no waiter any more
        self._waiting.clear()
        if self.engaged is not None and not self.engaged.done():
            self.engaged.set_exception(self.death(code))
            self.engaged.exception()
        self.child.close()
        self.gone.set()

    def _take(self, data: bytes) -> None:
        try:
            message = self._decoder.decode(data)
        except codec.MALFORMED as error:
            text = f"the task sent an invalid message: {error}"
            self._tell(
                self,
                rtpu_messages.Notice(
                    severity=int(Severity.ERROR), code="PROTOCOL", text=text
                ),
            )
            return
        if isinstance(message, rtpu_messages.Done):
            self._finished(message)
            return
        if message.state:
            self.state = State(message.state)
        if message.code == "ENGAGED" and self.engaged and not self.engaged.done():
            self.engaged.set_result(message)
        self._tell(self, message)

    def _finished(self, message: rtpu_messages.Done) -> None:
        self.state = State(message.state)
        if message.lost:
            total = sum(message.lost.values())
            notice = rtpu_messages.Notice(
                severity=int(Severity.WARNING),
                code="LOST",
                text=f"{total} notices did not fit; they are counted",
                lost=message.lost,
            )
            self._tell(self, notice)
        if message.error is not None and self.state is State.ERROR:
            self.error = str(error_of(message))
        self._busy.pop(message.n, None)
        answer = self._waiting.pop(message.n, None)
        if answer is not None and not answer.done():
            answer.set_result(message)

    def death(self, code: int) -> TaskDiedError:
        """Return the error that says how the task ended."""
        how = describe_end(code)
        return TaskDiedError(
            self.ending or f"the task ended by itself: {how}",
            where=self.name,
            remedy="spawn it again when the cause is gone",
            debug=self.child.crash_text(),
        )

    def _read_output(self) -> None:
        import os

        with contextlib.suppress(BlockingIOError, OSError):
            for _ in range(16):  # a bounded share of the loop for one talkative task
                data = os.read(self.child.out, 65536)
                if not data:
                    asyncio.get_running_loop().remove_reader(self.child.out)
                    return
                self._lines.feed(data)
                self._changed()

    def _printed(self, line: str) -> None:
        self._tell(
            self,
            rtpu_messages.Notice(severity=int(Severity.INFO), code="OUTPUT", text=line),
        )


def error_of(done: rtpu_messages.Done | rtpu_messages.Notice) -> PbonetError:
    """Return the error of an answer or a notice as an exception."""
    error = PbonetError.from_wire(done.error or {})
    if isinstance(error, MethodError):
        error.number, error.place = done.errnum, done.place
    return error


def crash_place(trace: str) -> str:
    """Return the innermost line of Python in what a crash left, if any."""
    found = _FRAME.search(trace)
    return "{}:{} in {}".format(*found.groups()) if found else ""


_FRAME = re.compile(r'File "([^"]+)", line (\d+) in (.+)')


async def rest(core: rt.CoreTable, task: Task) -> None:
    """End the standby of a task that did not come on.

    For one that has died, what it waited for stays known until its end is reported.
    """
    if not core.snapshot(task.facts.slot).dead:
        core.follow(task.facts.slot, [])
    with contextlib.suppress(PbonetError):
        await task.command("rest", lambda n: rtpu_messages.Prepare(n, []), 1.0)
