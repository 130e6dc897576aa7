"""Semaphores and message queues in shared memory (Stewart 1994, section 5.4).

Times are absolute, in nanoseconds of CLOCK_MONOTONIC (`time.monotonic_ns`, or
``self.task.now`` in a module): None waits for ever, what is over does not wait. A wait
runs the Python handlers of signals that arrive; one that raises ends the wait, and
nothing is taken. `still` is asked every `PATROL_NS`, and ends the wait with `XmError`
when it says False. Every wait checks for dead processes each `PATROL_NS`, so what a
killed process leaves is found within that time.
"""

from collections.abc import Callable
from enum import IntEnum
from types import TracebackType

from _typeshed import ReadableBuffer, WriteableBuffer

from .names import Name

PATROL_NS: int
"""How often a sleeper checks for dead processes, nanoseconds."""

class Taken(IntEnum):
    """The result of a P; only a time-out is false."""

    TIMED_OUT = 0
    TAKEN = 1
    HOLDER_DIED = 2
    """Taken; but the last holder died with it: what it guards may be half changed."""

class Policy(IntEnum):
    """Which message is received first."""

    FIFO = 0
    LIFO = 1
    HPF = 2
    """Of the highest priority; first in, first out among equals."""

class Full(IntEnum):
    """The policy for a message when the queue is full."""

    REFUSE = 0
    """`XmQueueFullError`."""
    DROP = 1
    """It is dropped and counted; `Queue.send` returns False."""
    DROP_OLDEST = 2
    """Room is made: the oldest go, of HPF the oldest of the lowest priority."""

class Shared:
    """Base of semaphores and queues."""

    @property
    def name(self) -> str:
        """``RTPU:RESOURCE``."""
    @property
    def path(self) -> str:
        """The file in shared memory; empty when it is another machine's."""
    @property
    def waiting(self) -> int:
        """How many threads wait in its line."""
    def close(self) -> None:
        """Detach; it stays for the others, and for who attaches later.

        A binary semaphore that this process holds counts as one whose holder died.

        Raises:
            XmError: A thread of this process waits in it.
        """
    def destroy(self) -> None:
        """Remove it; its users and waiters get `XmDestroyedError`."""

class Semaphore(Shared):
    """A semaphore, counting or binary (section 5.4.2).

    While no thread waits, P and V are one atomic operation each and make no system
    call. V never waits, so it may be called in a cycle.
    """

    @staticmethod
    def create(
        name: str | Name,
        *,
        initial: int = 1,
        maximum: int | None = None,
        binary: bool = False,
    ) -> Semaphore:
        """Make a semaphore; one without users is replaced.

        Args:
            name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
            initial: Its value, at least 0.
            maximum: Its highest value; 2**31 - 1 by default.
            binary: For a critical section: the value is 0 or 1 and the holder known.

        Raises:
            XmExistsError: One of that name is in use.
            UnreachableError: The RTPU is on no machine that can be reached.
            XmError: Its file cannot be made.
            ValueError: `initial` or `maximum` is out of bounds.
        """
    @staticmethod
    def attach(name: str | Name) -> Semaphore:
        """Attach to an existing semaphore.

        Raises:
            XmMissingError: There is none of that name.
            UnreachableError: The RTPU is on no machine that can be reached.
            XmError: Its file is not ours, damaged, or of another version.
        """
    @property
    def value(self) -> int:
        """How many could be taken now."""
    @property
    def maximum(self) -> int: ...
    @property
    def binary(self) -> bool: ...
    @property
    def holder(self) -> int | None:
        """The process that holds a binary semaphore; it may have died with it."""
    def p(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        still: Callable[[], bool] | None = None,
    ) -> Taken:
        """Take one, in the line of those who wait if there is none.

        Args:
            until_ns: When to give up.
            priority: Higher is served first, equals as they came; the task's
                criticality by default.
            still: See above.

        Raises:
            XmDestroyedError: It was destroyed.
            XmFullError: More than 128 threads wait, or processes are attached.
        """
    def try_p(self) -> Taken:
        """Take one if there is one that is not promised to a thread in the line."""
    def v(self) -> bool:
        """Give one back, or signal; False when the value stands at its maximum."""
    def __enter__(self) -> Taken: ...
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

class Queue(Shared):
    """A message queue (section 5.4.3): bounded, allocated when it is made.

    A message takes a header and as many blocks as it needs, so long ones stand beside
    short ones without waste. What a process that dies had in hand is lost, nothing
    else.
    """

    @property
    def last_priority(self) -> int:
        """Priority of the message received last through this handle."""
    @staticmethod
    def create(
        name: str | Name,
        *,
        policy: Policy = ...,
        messages: int = 64,
        blocks: int | None = None,
        block: int = 64,
    ) -> Queue:
        """Make a queue; one without users is replaced.

        Args:
            name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
            policy: Which message is received first.
            messages: How many it holds at most.
            blocks: How many blocks they share; as many as messages.
            block: Bytes of a block, at least 8; best an average message's size.

        Raises:
            XmExistsError: One of that name is in use.
            UnreachableError: The RTPU is on no machine that can be reached.
            XmError: Its file cannot be made.
            ValueError: A size is out of bounds.
        """
    @staticmethod
    def attach(name: str | Name) -> Queue:
        """Attach to an existing queue.

        Raises:
            XmMissingError: There is none of that name.
            UnreachableError: The RTPU is on no machine that can be reached.
            XmError: Its file is not ours, damaged, or of another version.
        """
    def __len__(self) -> int:
        """Return how many messages wait to be received."""
    @property
    def policy(self) -> Policy: ...
    @property
    def messages(self) -> int: ...
    @property
    def blocks(self) -> int: ...
    @property
    def block(self) -> int: ...
    @property
    def free(self) -> tuple[int, int]:
        """Free headers and blocks."""
    @property
    def sent(self) -> int:
        """Messages that were put in since it was made."""
    @property
    def dropped(self) -> int:
        """Messages dropped since it was made, because there was no room."""
    def send(
        self,
        data: ReadableBuffer,
        priority: int = 0,
        *,
        full: Full = ...,
        until_ns: int | None = 0,
        wait_priority: int | None = None,
        still: Callable[[], bool] | None = None,
    ) -> bool:
        """Put a message in; True when it is in.

        Args:
            data: Its bytes; they are copied.
            priority: Of the message, for HPF and for its receiver.
            full: What becomes of it when there is no room, at `until_ns` at the latest.
            until_ns: How long to wait for room; not at all by default.
            wait_priority: Of that wait; the task's criticality by default.
            still: See above.

        Raises:
            XmQueueFullError: There is no room, and `full` says REFUSE.
            XmTooLongError: It is longer than the whole queue.
            XmDestroyedError: The queue was destroyed.
        """
    def receive(
        self, until_ns: int | None = None, *, priority: int | None = None
    ) -> bytes | None:
        """Take the first message; None when the time is over and there is none.

        Args:
            until_ns: When to give up.
            priority: Of this receiver among those who wait; the task's criticality by
                default.

        Raises:
            XmDestroyedError: The queue was destroyed.
            XmFullError: Too many wait or are attached.
        """
    def letter(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        most: int = ...,
        still: Callable[[], bool] | None = None,
    ) -> tuple[bytes, int] | None:
        """Take the first message with its priority; else as `receive`.

        Args:
            until_ns: When to give up.
            priority: As for `receive`.
            most: Bytes at most; a longer message stays in the queue.
            still: See above.

        Raises:
            XmTooLongError: It is longer than `most`.
            XmDestroyedError: The queue was destroyed.
        """
    def wait(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        still: Callable[[], bool] | None = None,
    ) -> bool:
        """Wait for a message and leave it in the queue; False when the time is over.

        For a module's `sync`: whatever ends it, no message is lost. `cycle` takes it
        with `try_receive`, which gives None if another receiver was quicker.

        Raises:
            XmDestroyedError: The queue was destroyed.
            XmFullError: Too many wait or are attached.
        """
    def try_receive(self) -> bytes | None:
        """Take the first message, if it is not promised to a thread in the line."""
    def receive_into(
        self,
        buffer: WriteableBuffer,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
    ) -> int | None:
        """Copy the first message straight to `buffer`; return how many bytes it has.

        Raises:
            XmTooLongError: It is longer than the buffer; it stays in the queue.
            XmDestroyedError: The queue was destroyed.
        """
