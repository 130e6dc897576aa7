"""Semaphores and message queues in shared memory (Stewart 1994, section 5.4).

Times are absolute, in nanoseconds of CLOCK_MONOTONIC (`time.monotonic_ns`, or
``self.task.now`` in a module): None waits without limit, a time in the past does not
wait. A wait runs the Python handlers of signals that arrive; one that raises ends the
wait, and nothing is taken. `still` is called every `PATROL_NS`, and ends the wait with
`XmError` when it returns False. Every wait also checks for dead processes at that
interval, so what a killed process leaves behind is found within it.
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
    """Taken; but the last holder died with it: what it protects may be inconsistent."""

class Policy(IntEnum):
    """Order in which messages are received."""

    FIFO = 0
    LIFO = 1
    HPF = 2
    """Highest priority first; first in, first out among equals."""

class Full(IntEnum):
    """The policy for a message when the queue is full."""

    REFUSE = 0
    """`XmQueueFullError`."""
    DROP = 1
    """The message is dropped and counted; `Queue.send` returns False."""
    DROP_OLDEST = 2
    """Makes room: drops the oldest; with HPF the oldest of the lowest priority."""

class Shared:
    """Base of semaphores and queues."""

    @property
    def name(self) -> str:
        """``RTPU:RESOURCE``."""
    @property
    def path(self) -> str:
        """The file in shared memory; empty if it is on another machine."""
    @property
    def waiting(self) -> int:
        """Number of threads that wait for it."""
    def close(self) -> None:
        """Detach; the object remains for other and later users.

        If this process holds a binary semaphore, it counts as a holder that died.

        Raises:
            XmError: A thread of this process waits for it.
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
        """Make a semaphore; an existing one without users is replaced.

        Args:
            name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
            initial: Its initial value, at least 0.
            maximum: Its highest value; 2**31 - 1 by default.
            binary: For a critical section: the value is 0 or 1, the holder is known.

        Raises:
            XmExistsError: A semaphore of that name is in use.
            UnreachableError: No reachable machine has the RTPU.
            XmError: The file cannot be made.
            ValueError: `initial` or `maximum` is out of bounds.
        """
    @staticmethod
    def attach(name: str | Name) -> Semaphore:
        """Attach to an existing semaphore.

        Raises:
            XmMissingError: There is no semaphore of that name.
            UnreachableError: No reachable machine has the RTPU.
            XmError: The file is another user's, damaged, or of another version.
        """
    @property
    def value(self) -> int:
        """How often it could be taken now."""
    @property
    def maximum(self) -> int: ...
    @property
    def binary(self) -> bool: ...
    @property
    def holder(self) -> int | None:
        """The process that holds a binary semaphore; it may have died."""
    def p(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        still: Callable[[], bool] | None = None,
    ) -> Taken:
        """Take one; wait in line if there is none.

        Args:
            until_ns: Time-out.
            priority: Higher priorities are served first, equal ones in order of
                arrival; the task's criticality by default.
            still: See the module's description.

        Raises:
            XmDestroyedError: It was destroyed.
            XmFullError: More than 128 threads wait, or 128 processes are attached.
        """
    def try_p(self) -> Taken:
        """Take one unless none is left or it is reserved for a waiting thread."""
    def v(self, *, answer: bool = True) -> bool:
        """Give one back, or signal; False if the value is at its maximum.

        Args:
            answer: For a semaphore of another machine: whether to wait for its answer.
                Without one the call returns True at once, as `xmWakeup` (Stewart
                1994, section 5.3.1), and a failure is an event, NOT_DELIVERED.

        Raises:
            XmFullError: Without an answer: the agent takes no signals now.
        """
    def __enter__(self) -> Taken: ...
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

class Queue(Shared):
    """A message queue (section 5.4.3): bounded, allocated when it is made.

    A message takes a header and as many blocks as it needs, so long and short ones
    share the memory without waste. If a process dies, only the messages that it was
    copying are lost.
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
        """Make a queue; an existing one without users is replaced.

        Args:
            name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
            policy: Order in which messages are received.
            messages: Maximum number of messages.
            blocks: Number of blocks that they share; `messages` by default.
            block: Bytes of a block, at least 8; best the size of an average message.

        Raises:
            XmExistsError: A queue of that name is in use.
            UnreachableError: No reachable machine has the RTPU.
            XmError: The file cannot be made.
            ValueError: A size is out of bounds.
        """
    @staticmethod
    def attach(name: str | Name) -> Queue:
        """Attach to an existing queue.

        Raises:
            XmMissingError: There is no queue of that name.
            UnreachableError: No reachable machine has the RTPU.
            XmError: The file is another user's, damaged, or of another version.
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
        """Number of free headers and of free blocks."""
    @property
    def sent(self) -> int:
        """Number of messages sent since it was made."""
    @property
    def dropped(self) -> int:
        """Number of messages dropped for lack of room since it was made."""
    def send(
        self,
        data: ReadableBuffer,
        priority: int = 0,
        *,
        full: Full = ...,
        until_ns: int | None = 0,
        wait_priority: int | None = None,
        still: Callable[[], bool] | None = None,
        answer: bool = True,
    ) -> bool:
        """Put a message in the queue; return whether it was put.

        Args:
            data: Its bytes; they are copied.
            priority: Of the message, for HPF and for its receiver.
            full: What to do if there is still no room at `until_ns`.
            until_ns: Time-out of the wait for room; no wait by default.
            wait_priority: Priority of that wait; the task's criticality by default.
            still: See the module's description.
            answer: For a queue of another machine: whether to wait for its answer, as
                in `Semaphore.v`. Messages without one arrive in their order, and have
                at most 64 KiB.

        Raises:
            XmQueueFullError: There is no room, and `full` is REFUSE.
            XmTooLongError: It is longer than the whole queue.
            XmFullError: Without an answer: the agent takes no messages now.
            ValueError: Without an answer there can be no wait for room.
            XmDestroyedError: The queue was destroyed.
        """
    def receive(
        self, until_ns: int | None = None, *, priority: int | None = None
    ) -> bytes | None:
        """Take the first message; None if there is none until the time-out.

        Args:
            until_ns: Time-out.
            priority: Of this receiver among the waiters; the task's criticality by
                default.

        Raises:
            XmDestroyedError: The queue was destroyed.
            XmFullError: Too many threads wait, or too many processes are attached.
        """
    def letter(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        most: int = ...,
        still: Callable[[], bool] | None = None,
    ) -> tuple[bytes, int] | None:
        """Take the first message with its priority; otherwise as `receive`.

        Args:
            until_ns: Time-out.
            priority: As for `receive`.
            most: Maximum size in bytes; a longer message stays in the queue.
            still: See the module's description.

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
        """Wait for a message and leave it in the queue; False at the time-out.

        For a module's `sync`: no message is lost however the wait ends. `cycle` takes
        it with `try_receive`, which returns None if another receiver was quicker.

        Raises:
            XmDestroyedError: The queue was destroyed.
            XmFullError: Too many threads wait, or too many processes are attached.
        """
    def try_receive(self) -> bytes | None:
        """Take the first message unless it is reserved for a waiting thread."""
    def receive_into(
        self,
        buffer: WriteableBuffer,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
    ) -> int | None:
        """Copy the first message directly to `buffer`; return its size in bytes.

        Raises:
            XmTooLongError: It is longer than the buffer; it stays in the queue.
            XmDestroyedError: The queue was destroyed.
        """
