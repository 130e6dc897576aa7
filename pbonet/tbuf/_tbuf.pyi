"""Triple buffers in shared memory: the native half of `pbonet.tbuf`.

Times are nanoseconds of CLOCK_MONOTONIC; as a default, 0 means now.
"""

from typing import Any

from numpy.typing import NDArray

from pbonet.outside import Outside

WRITER: int
READER: int
CARER: int
"""Roles of a buffer: its writer, its reader, and the agent that supervises it."""
LONGEST_TEXT: int
"""Maximum size of a record's description, in bytes."""

def size_for(record: int) -> int:
    """Return the size of the file for records of this size, both in bytes."""

def parts(message: bytes) -> tuple[int, int, int, int, bytes, bytes]:
    """Return the parts of a message between machines.

    Returns:
        Counter, source of the counter, time and age at sending in nanoseconds, the
        description of the record, and its bytes.

    Raises:
        ProtocolError: The message is malformed, or of another version.
    """

class Buffer:
    """A buffer's file, mapped whole."""

    fileno: int
    path: str
    def map(self, fd: int, size: int, path: str) -> None:
        """Map an open file; the descriptor belongs to the object from here on."""
    def unmap(self) -> None:
        """Unmap and close. Idempotent."""
    def make(self, record: int, source: int, text: bytes) -> None:
        """Fill fresh zeroed memory.

        Args:
            record: Bytes of a record.
            source: A number that distinguishes this buffer's counter from others.
            text: Description of a record's layout.
        """
    def verify(self) -> None:
        """Check the file; other methods may be called only if it passes.

        Raises:
            XmLayoutError: It is of another version, or in another byte order.
            XmDamagedError: It is not a buffer, or was overwritten.
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
        """Record the user of a role, for error messages."""
    def who(self, role: int) -> str:
        """Return the last user of a role."""

class End(Buffer):
    """One end of a link."""

    value: NDArray[Any]
    """The process's own copy of a record, at one address for life."""
    outside: Outside | None
    """Records or replays what is read; None: neither."""
    def hold(
        self,
        raw: NDArray[Any],
        own: NDArray[Any],
        value: NDArray[Any],
        outside: Outside | None = None,
    ) -> None:
        """Set the arrays that records are copied from or to.

        Args:
            raw: A record as stored in the buffer.
            own: A record in the process's own byte order; `raw` if that is the same.
            value: `own` as presented to the user.
            outside: Recorder of the inputs of the module that owns this end, if any.
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
        """Continue the counter of the last writer."""
    def write(self, now_ns: int = 0) -> None:
        """Write `value` as the newest record; never waits.

        With a remote reader it costs one wake-up, after the cycle if a task is in one.

        Args:
            now_ns: Time stamp of the record.

        Raises:
            XmError: The link is closed, or was destroyed.
        """
    def take(
        self,
        message: bytes,
        now_ns: int,
        offset_ns: int | None,
        error_ns: int = 0,
        *,
        turned: bool = False,
    ) -> bool:
        """Write a record received from another machine, with that machine's counter.

        Args:
            message: The received message.
            now_ns: When it arrived, CLOCK_MONOTONIC.
            offset_ns: From the other machine's clock to this one's; None: not known,
                and the record counts as old.
            error_ns: By how much more the record may seem to come from the future: the
                clocks are not as measured then, and it counts as old, too.
            turned: Its values are in the held array, converted to this byte order.

        Returns:
            Whether it was written; False if its layout is described differently.

        Raises:
            ProtocolError: It is not a message, or its record is truncated.
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
            Whether it is new; if not, nothing was copied. The first call returns any
            existing record as new, even if an earlier reader has read it.

        Raises:
            XmError: The link is closed, or was destroyed.
        """
    def wait(self, until_ns: int | None = None) -> bool:
        """Wait for a record that was not read; return whether there is one.

        Python signal handlers run; one that raises ends the wait.

        Args:
            until_ns: Time-out; None waits without limit.
        """
    @property
    def stamp_ns(self) -> int:
        """When the last record was written, by the clock of the writer's machine."""
    def age_ns(self, now_ns: int = 0) -> int | None:
        """Return the age of the last record read; None if none was."""
    def message(self, until_ns: int) -> bytes | None:
        """Wait for a record and return it as a message for another machine.

        Records that come regularly are expected awake, for some 50 microseconds each.

        Args:
            until_ns: Time-out.

        Returns:
            The newest record; None when none came.

        Raises:
            XmError: The link is closed, or was destroyed.
        """
