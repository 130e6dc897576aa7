"""An event loop in virtual time, with sockets that never wait.

The code of an RTPU process is asynchronous, as it waits for tasks and for time. In
virtual time its coroutines run on this loop, in the thread that lets time pass.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import math
from asyncio import events
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar, TypeVarTuple, Unpack

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Generator
    from contextvars import Context

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

BEGIN_NS = 1_000_000_000
"""The virtual clock's first instant."""


class VirtualLoop(asyncio.AbstractEventLoop):
    """Runs callbacks of one instant in their order, and timers as time passes.

    Args:
        now_ns: The first instant.
    """

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns
        self._ready: deque[asyncio.Handle] = deque()
        self._timers: list[tuple[float, int, asyncio.TimerHandle]] = []
        self._count = itertools.count()
        self._failed: BaseException | None = None

    # -- what asyncio asks for ---------------------------------------------------------

    def time(self) -> float:
        """Return the virtual seconds."""
        return self.now_ns * 1e-9

    def call_soon(  # noqa: D102 - asyncio's
        self,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.Handle:
        handle = asyncio.Handle(callback, args, self, context)
        self._ready.append(handle)
        return handle

    def call_later(  # noqa: D102 - asyncio's
        self,
        delay: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        return self.call_at(self.time() + delay, callback, *args, context=context)

    def call_at(  # noqa: D102 - asyncio's
        self,
        when: float,
        callback: Callable[[Unpack[Ts]], object],
        *args: *Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        handle = asyncio.TimerHandle(when, callback, args, self, context)
        heapq.heappush(self._timers, (when, next(self._count), handle))
        return handle

    def create_future(self) -> asyncio.Future[Any]:  # noqa: D102 - asyncio's
        return asyncio.Future(loop=self)

    def create_task(  # noqa: D102 - asyncio's
        self,
        coro: Generator[Any, None, T] | Coroutine[Any, Any, T],
        *,
        name: str | None = None,
        context: Context | None = None,
    ) -> asyncio.Task[T]:
        return asyncio.Task(coro, loop=self, name=name, context=context)

    def get_debug(self) -> bool:  # noqa: D102 - asyncio's
        return False

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Let an unhandled error propagate out of `run`."""
        self._failed = self._failed or context.get("exception")

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        """Do nothing: it is passed over when its time comes."""

    def add_reader(self, fd: object, callback: object, *args: object) -> None:
        """Do nothing: what tasks print goes where this process prints."""

    def remove_reader(self, fd: object) -> bool:  # noqa: D102 - asyncio's
        del fd
        return False

    async def sock_recv(self, sock: Channel, nbytes: int) -> bytes:  # type: ignore[override]
        """Return the next message; b"" when the other end is closed."""
        del nbytes
        return await sock.receive()

    # -- time --------------------------------------------------------------------------

    @property
    def due_ns(self) -> int:
        """When the next timer is due; 0: there is none."""
        while self._timers and self._timers[0][2].cancelled():
            heapq.heappop(self._timers)
        return math.ceil(self._timers[0][0] * 1e9) if self._timers else 0

    def run(self) -> None:
        """Run the work of this instant."""
        while 0 < self.due_ns <= self.now_ns:
            self._ready.append(heapq.heappop(self._timers)[2])
        if not self._ready:
            return
        with running(self):
            while self._ready:
                handle = self._ready.popleft()
                if not handle.cancelled():
                    handle._run()  # noqa: SLF001 - as asyncio's own loops do
        if self._failed is not None:
            failed, self._failed = self._failed, None
            raise failed


def make_loop(now_ns: int) -> VirtualLoop:
    """Return a loop that begins at an instant."""
    make: Any = VirtualLoop  # the many unused methods of a loop are missing
    made: VirtualLoop = make(now_ns)
    return made


@contextmanager
def running(loop: VirtualLoop | None) -> Generator[None]:
    """Have a loop be the one that runs in this thread, in the block; None for none."""
    before = events._get_running_loop()  # noqa: SLF001 - meant for loops
    events._set_running_loop(loop)  # noqa: SLF001
    try:
        yield
    finally:
        events._set_running_loop(before)  # noqa: SLF001


class Channel:
    """One end of a pair of sockets in memory; `pair` makes both.

    Args:
        loop: Wakes the coroutine that waits for a message.
    """

    def __init__(self, loop: VirtualLoop) -> None:
        self._loop = loop
        self.messages: deque[bytes] = deque()
        self._waiting: asyncio.Future[None] | None = None
        self.closed = False
        self.other = self

    def send(self, data: bytes, flags: int = 0) -> int:
        """Send a message.

        Raises:
            BrokenPipeError: The other end is closed.
        """
        del flags
        if self.other.closed:
            raise BrokenPipeError("the other end is closed")
        self.other.messages.append(data)
        self.other.wake()
        return len(data)

    def recv(self, size: int, flags: int = 0) -> bytes:
        """Return the next message; b"" when the other end is closed.

        Raises:
            BlockingIOError: There is none now.
        """
        del size, flags
        if self.messages:
            return self.messages.popleft()
        if self.other.closed:
            return b""
        raise BlockingIOError

    def recv_into(self, buffer: bytearray, size: int, flags: int) -> int:
        """Return the size of the next message, and leave it there.

        Raises:
            BlockingIOError: There is none now.
        """
        del buffer, size, flags
        if not self.messages and not self.other.closed:
            raise BlockingIOError
        return len(self.messages[0]) if self.messages else 0

    async def receive(self) -> bytes:
        """Wait for the next message and return it, as `recv` does."""
        while not (self.messages or self.other.closed or self.closed):
            self._waiting = self._loop.create_future()
            await self._waiting
        return b"" if self.closed else self.recv(0)

    @property
    def waits(self) -> bool:
        """Whether a message waits to be received."""
        return bool(self.messages)

    def close(self) -> None:
        """Close this end; the other one is notified."""
        self.closed = True
        self.wake()
        self.other.wake()

    def wake(self) -> None:
        """Wake the reader that waits for a message."""
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(None)


def pair(loop: VirtualLoop) -> tuple[Channel, Channel]:
    """Return both ends of a pair of sockets."""
    near, far = Channel(loop), Channel(loop)
    near.other, far.other = far, near
    return near, far
