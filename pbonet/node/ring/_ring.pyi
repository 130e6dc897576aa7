"""A ring of cycle records in shared memory, one per task."""

class Record:
    """One record of a ring."""

    cycle: int
    release_ns: int
    start_ns: int
    """When ``cycle`` was called."""
    end_ns: int
    """When the commit was complete."""
    dt_ns: int
    """The time step that was passed to ``cycle``."""
    cpu_ns: int
    uid: int
    """The register of the commit; 0: none."""
    number: int
    """The number of the commit in that register."""
    lost: int
    """Records that the ring had dropped before this one."""
    flags: int
    kind: int
    """The kind of step (`pbonet.log.Step`); 0: a cycle."""
    stable: bool
    consumed: tuple[tuple[int, int], ...]
    """(register, number) pairs of the copy-in."""
    data: bytes
    """The out-group as committed."""
    inputs: bytes
    """The in-vars as copied in; empty if they follow from `consumed`."""
    heard: bytes
    """The cycle's inputs from outside the table; see `pbonet.outside`."""

def parse(text: bytes) -> list[Record]:
    """Return the records in the result of `Ring.take`.

    Raises:
        NodeError: They are damaged.
    """

class Ring:
    """Single producer, single consumer: ``pbonet.<uid>.<name>.ring``.

    A full ring drops the new record and counts it; the producer never waits.
    """

    name: str
    path: str
    lost: int
    about: bytes
    """The description given by its creator."""
    @staticmethod
    def create(name: str, capacity: int = 1 << 20, about: bytes = b"") -> Ring:
        """Make the file (replacing an existing one) and return the producer's end.

        Args:
            name: At most 100 characters, for instance ``subsystem.task``.
            capacity: Bytes, rounded up to a power of two.
            about: A description for the process that drains the ring.
        """
    @staticmethod
    def attach(name: str) -> Ring:
        """Open an existing ring, as producer or consumer."""
    def put(
        self,
        data: bytes,
        *,
        cycle: int = 0,
        kind: int = 0,
        now_ns: int = 0,
        uid: int = 0,
        number: int = 0,
    ) -> bool:
        """Append one record; False when the ring is full."""
    def drain(self, limit: int = 0) -> list[Record]:
        """Take the waiting records, oldest first (0: all).

        Raises:
            NodeError: Another process drains this ring.
        """
    def take(self) -> bytes:
        """Take the waiting records as bytes, for `parse` or for a log.

        Raises:
            NodeError: Another process drains this ring.
        """
    def want(self, *, always: bool = False) -> None:
        """Ask for the inputs of the next cycle, or of every cycle."""
    def close(self) -> None: ...
    def destroy(self) -> None:
        """Close and remove the file."""
