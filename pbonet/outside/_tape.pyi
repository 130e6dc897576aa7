"""A module's inputs from outside the table: recorded for the log, or replayed from it.

A process uses one tape at a time: the task's while it is recorded, a `Player`
while a log is replayed. Without one, sources are asked and nothing is kept.
"""

from collections.abc import Callable
from typing import Final, TypeVar

from .playing import Player

_T = TypeVar("_T")

ROOM: int
"""Bytes of a tape, before more is reserved."""
ALWAYS: Final[object]
"""The value of `default` for "none": every answer is recorded."""
RAW: int
PACKED: int
TUPLE: int
RAISED: int
BROKEN: int
NAME: int
LOST: int
"""Kinds of entries: bytes, msgpack, msgpack of a tuple, an exception, a wait that was
interrupted by a command, a source's name, and the mark of lost entries."""

def use(tape: Tape | Player | None) -> Tape | Player | None:
    """Set the tape of sources opened from now on; return the previous one."""

def active() -> bool:
    """Return whether answers are recorded or replayed."""

def plays() -> bool:
    """Return whether a log is replayed, so that nothing outside may be touched."""

class Tape:
    """Inputs since the tape was emptied; filling it allocates nothing."""

    opened: int
    """Number of sources opened so far."""
    def __init__(self, room: int = ...) -> None: ...
    def reserve(self, size: int) -> None:
        """Add room for one answer of this size, up to 4 MiB; not in a cycle."""
    def take(self) -> bytes:
        """Return all entries, and empty the tape."""
    def calls(self) -> list[int]:
        """Return how often each source was asked, in the order they were opened."""

class Outside:
    """Something outside that a module asks: its answers are recorded and replayed.

    A driver reads through this class, so that the module's log can be verified::

        class Scale:
            def __init__(self, path: str) -> None:
                self._outside = Outside(f"scale {path}")
                self._fd = self._outside.ask(os.open, path, os.O_RDONLY)

            def grams(self) -> float:
                return self._outside.ask(self._read)

    Args:
        name: Description of the source; the replay must open the same one.
        room: Bytes of its longest answer, if that may exceed some thousand.
    """

    name: str
    number: int
    calls: int
    def __init__(self, name: str, *, room: int = 0) -> None: ...
    @property
    def plays(self) -> bool:
        """Whether answers come from a log, and nothing outside is touched."""
    def ask(self, call: Callable[..., _T], *args: object, default: object = ...) -> _T:
        """Return what `call` returns; in a replay, what it returned then.

        Exceptions are recorded and raised again.

        Args:
            call: Reads the source. It is not called in a replay.
            args: Its arguments.
            default: An answer that is not worth a record, such as ``b""`` of a line
                where nothing has arrived.

        Raises:
            DeviceError: The answer is of a type that cannot be recorded; possible are
                None, numbers, text, bytes, and tuples, lists or dictionaries of these.
        """
