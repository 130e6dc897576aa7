"""Makes messages of the records of a ring, and single cycles of messages."""

import numpy as np
from numpy.typing import NDArray

class Layout:
    """Where the variables of a task are in its messages.

    Args:
        pieces: For each variable its place in the group and its size, and its places in
            a message: of the last cycle, and from the begin of an earlier one.
        blanks: Place and size of each in-var whose value is not recorded.
        last: Bytes of the last cycle before its byte sequences.
        earlier: The same of an earlier one.
    """

    def __init__(
        self,
        pieces: list[tuple[int, int, int, int]],
        blanks: list[tuple[int, int]],
        last: int,
        earlier: int,
        /,
    ) -> None: ...
    def fold(
        self, records: bytes, span_ns: int, /
    ) -> list[tuple[int, int, int, int, bytes]]:
        """Return the messages of records as they came from a ring.

        Consecutive cycles go into one message, as long as each follows from the next
        one but for its times, values and inputs, and they ended within `span_ns`.

        Returns:
            The kind of each record, how many there are in the message, release and end
            of the last one, and the message; of records that are no commits the record
            itself.

        Raises:
            NodeError: The records are damaged.
        """

    def unfold(
        self, data: bytes, sizes: NDArray[np.int64], /
    ) -> tuple[bytes, bytes, bytes] | None:
        """Return the cycles of messages, each as a message of its own.

        Args:
            data: Messages, one after the other.
            sizes: The size of each in bytes, shape ``(n,)``.

        Returns:
            The new messages, one after the other; their sizes, and how many each given
            one had, as int64. None if a message is too short for what it says.
        """
