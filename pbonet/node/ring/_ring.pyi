"""A ring of cycle records in shared memory, one per task."""

class Record:
    """One record, out of a ring."""

    cycle: int
    release_ns: int
    start_ns: int
    """When ``cycle`` was called."""
    end_ns: int
    """When the commit was done."""
    dt_ns: int
    """The time step that ``cycle`` was told."""
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
    """The in-vars as copied in, where they do not follow from `consumed`."""
    heard: bytes
    """The cycle's inputs from outside the table; see `pbonet.outside`."""

def parse(text: bytes) -> list[Record]:
    """Return the records in what `Ring.take` returned.

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
    """Its maker's description."""
    @staticmethod
    def create(name: str, capacity: int = 1 << 20, about: bytes = b"") -> Ring:
        """Make the file (replacing one that stands) and return its producer's end.

        Args:
            name: At most 100 characters, for instance ``subsystem.task``.
            capacity: Bytes, rounded up to a power of two.
            about: Whose it is, for whoever drains it.
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
        """Take the records that stand in the ring, oldest first (0: all).

        Raises:
            NodeError: Another process drains this ring.
        """
    def take(self) -> bytes:
        """Take the same as bytes, for `parse` or for a log.

        Raises:
            NodeError: Another process drains this ring.
        """
    def want(self, *, always: bool = False) -> None:
        """Have the next cycle store its inputs, or each cycle."""
    def close(self) -> None: ...
    def destroy(self) -> None:
        """Close and remove the file."""
