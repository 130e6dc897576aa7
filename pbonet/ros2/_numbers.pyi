from typing import Any

from numpy.typing import NDArray

from .field_paths import Slice

class Filler:
    """Makes messages of one layout, of numbers that it copies from where they are.

    Args:
        message: The message in CDR with all that does not change.
        parts: Places in it, and the numbers that are copied there.
        stamps: Places of the time stamps in it.

    Raises:
        ValueError: A place is outside of the message.
    """

    def __init__(
        self,
        message: bytearray,
        parts: list[tuple[int, NDArray[Any]]],
        stamps: list[int],
    ) -> None: ...
    def fill(self, stamp_ns: int) -> bytes:
        """Return a message with the numbers as they are now.

        Args:
            stamp_ns: The time in its stamps, nanoseconds since 1970.
        """

class Taker:
    """Copies numbers out of messages of one layout.

    Args:
        mask: 255 for each byte that is the same in all of them.
        rest: These bytes, and 0 for the others.
        parts: Where the numbers stand.
        to: Where they are copied.
        stamp: The place of the header's time stamp; -1: there is none.

    Raises:
        ValueError: A place is outside of the message or the numbers.
    """

    def __init__(
        self,
        mask: bytes,
        rest: bytes,
        parts: list[Slice],
        to: NDArray[Any],
        stamp: int,
    ) -> None: ...
    @property
    def stamp_ns(self) -> int:
        """The time stamp of the last message, nanoseconds since 1970."""
    def take(self, data: bytes) -> bool:
        """Copy the numbers of a message.

        Returns:
            Whether it has the layout, and all of its numbers are finite.
        """
