"""Triple buffers in shared memory: the native half of `pbonet.tbuf`.

Times are nanoseconds of CLOCK_MONOTONIC; where one may be left out, 0 means now.
"""

from typing import Any

from numpy.typing import NDArray

from pbonet.outside import Outside

WRITER: int
READER: int
CARER: int
"""Users of a buffer: its writer, its reader, and the agent that cares for it."""
LONGEST_TEXT: int
"""Bytes for the description of a record."""

def size_for(record: int) -> int:
    """Return the size of the file for records of so many bytes."""

def parts(message: bytes) -> tuple[int, int, int, int, bytes, bytes]:
    """Return what a message between machines carries.

    Returns:
        Counter, whose it is, time and age at sending in nanoseconds, the description of
        the record, and its bytes.

    Raises:
        ProtocolError: It is malformed, or of another version.
    """

class Buffer:
    """A buffer's file, mapped whole."""

    fileno: int
    path: str
    def map(self, fd: int, size: int, path: str) -> None:
        """Map an open file; the descriptor belongs to the object from here on."""
    def unmap(self) -> None:
        """Unmap and close; harmless when done twice."""
    def make(self, record: int, source: int, text: bytes) -> None:
        """Fill fresh zeroed memory.

        Args:
            record: Bytes of a record.
            source: A number that tells this buffer's counter from others.
            text: What a record looks like.
        """
    def verify(self) -> None:
        """Judge the file; nothing else may be asked of one that does not pass.

        Raises:
            XmLayoutError: It is of another version, or in another byte order.
            XmDamagedError: It is no buffer, or was overwritten.
        """
    @property
    def text(self) -> bytes:
        """Layout of a record, as given to `make`."""
    @property
    def record(self) -> int:
        """Bytes of a record."""
    @property
    def written(self) -> int:
        """The counter of the newest record; 0 before the first."""
    @property
    def last_ns(self) -> int:
        """When the newest record was written; 0 before the first."""
    @property
    def destroyed(self) -> bool:
        """Whether it was destroyed."""
    def mark_destroyed(self) -> None:
        """Mark it as destroyed for all users."""
    def enter(self, role: int, who: str) -> None:
        """Note who has taken a role, for messages."""
    def who(self, role: int) -> str:
        """Return who took a role last."""

class End(Buffer):
    """One end of a link."""

    value: NDArray[Any]
    """The process's own copy of a record, at one address for life."""
    outside: Outside | None
    """Keeps what is read on record, or plays it; None: nothing does."""
    def hold(
        self,
        raw: NDArray[Any],
        own: NDArray[Any],
        value: NDArray[Any],
        outside: Outside | None = None,
    ) -> None:
        """Say where records are copied from or to, and what the process has of it.

        Args:
            raw: A record as it stands in the buffer.
            own: A record in the process's own byte order; `raw` if that is the same.
            value: `own`, as the user shall see it.
            outside: What the module that has this end is recorded by, if it is.
        """
    @property
    def number(self) -> int:
        """The counter of the last record written, or read; 0 before the first."""
    @property
    def time_ns(self) -> int:
        """When that record was written, by this machine's clock."""

class Out(End):
    """Writes records."""

    def begin(self) -> None:
        """Go on counting where the last writer stopped."""
    def write(self, now_ns: int = 0) -> None:
        """Write `value` as the newest record; never waits.

        A remote reader costs one wake-up, after the cycle if a task is in one.

        Args:
            now_ns: The time to stamp it with.

        Raises:
            XmError: The link is closed, or was destroyed.
        """
    def take(
        self,
        message: bytes,
        now_ns: int,
        offset_ns: int | None,
        *,
        turned: bool = False,
    ) -> bool:
        """Write a record of another machine, under its own counter.

        Args:
            message: What came from there.
            now_ns: When it came, CLOCK_MONOTONIC.
            offset_ns: From the other machine's clock to this one's; None: not known.
            turned: Its values stand in the array that was held, turned round.

        Returns:
            Whether it was written; not if it describes records in other words.

        Raises:
            ProtocolError: It is no message, or its record is cut short.
            XmError: The link is closed, or was destroyed.
        """

class In(End):
    """Reads records."""

    lost: int
    """Records that were written and never read, since the link was opened."""
    restarts: int
    """How often the counter restarted, because the writer's buffer was made again."""
    def read(self) -> bool:
        """Copy the newest record into `value`; never waits.

        Returns:
            Whether it is new; if not, nothing was copied. The first call counts as new
            whatever stands there, also if a former reader has read it.

        Raises:
            XmError: The link is closed, or was destroyed.
        """
    def wait(self, until_ns: int | None = None) -> bool:
        """Wait for a record that was not read; return whether there is one.

        Handlers of signals run; one that raises ends the wait.

        Args:
            until_ns: When to give up; None waits for ever.
        """
    @property
    def stamp_ns(self) -> int:
        """When the last record was written, by the clock of the writer's machine."""
    def age_ns(self, now_ns: int = 0) -> int | None:
        """Return the age of the last record read; None if none was."""
    def message(self, until_ns: int) -> bytes | None:
        """Wait for a record and return it as it goes to another machine.

        Records that come regularly are awaited awake, for some 50 microseconds each.

        Args:
            until_ns: When to give up.

        Returns:
            The newest record; None when none came.

        Raises:
            XmError: The link is closed, or was destroyed.
        """
