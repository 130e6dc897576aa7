"""A ring of cycle records in shared memory, one per task."""

class Record:
    """One cycle, out of a ring."""

    cycle: int
    release_ns: int
    start_ns: int
    """When ``cycle`` was called."""
    end_ns: int
    """When the commit was done."""
    cpu_ns: int
    flags: int
    stable: bool
    consumed: tuple[tuple[int, int], ...]
    """(register, sequence) pairs of the copy-in."""
    data: bytes
    """The out-group as committed."""

class Ring:
    """Single producer, single consumer: ``pbonet.<uid>.<name>.ring``.

    A full ring drops the new record and counts it; the producer never waits.
    """

    name: str
    path: str
    lost: int
    @staticmethod
    def create(name: str, capacity: int = 1 << 20) -> Ring:
        """Make the file (replacing one that stands) and return its producer's end.

        Args:
            name: At most 100 characters, for instance ``subsystem.task``.
            capacity: Bytes, rounded up to a power of two.
        """
    @staticmethod
    def attach(name: str) -> Ring:
        """Open an existing ring, as producer or consumer."""
    def put(self, data: bytes, *, cycle: int = 0) -> bool:
        """Append one record; False when the ring is full."""
    def drain(self, limit: int = 0) -> list[Record]:
        """Take the records that stand in the ring, oldest first (0: all).

        Raises:
            NodeError: Another process drains this ring.
        """
    def close(self) -> None: ...
    def destroy(self) -> None:
        """Close and remove the file."""
