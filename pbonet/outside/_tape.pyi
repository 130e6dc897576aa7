"""A module's inputs from outside the table: kept for the log, or played from it.

One tape is in use in a process at a time: the task's while it is recorded, a `Player`
while a log is run again. Without one, everything is asked and nothing kept.
"""

from collections.abc import Callable
from typing import Final, TypeVar

from .playing import Player

_T = TypeVar("_T")

ROOM: int
"""Bytes of a tape, before anything asks for more."""
ALWAYS: Final[object]
"""The default of who has none: every answer is kept."""
RAW: int
PACKED: int
TUPLE: int
RAISED: int
BROKEN: int
NAME: int
LOST: int
"""Kinds of entries: bytes, msgpack, msgpack of a tuple, an exception, a wait that a
command broke off, a source's name, and that something found no room."""

def use(tape: Tape | Player | None) -> Tape | Player | None:
    """Let sources that are opened from now on use this; return what was in use."""

def active() -> bool:
    """Return whether answers are kept, or played."""

def plays() -> bool:
    """Return whether a log is run again, so that nothing outside may be touched."""

class Tape:
    """Inputs since it was emptied; allocates nothing while it is filled."""

    opened: int
    """Sources so far."""
    def __init__(self, room: int = ...) -> None: ...
    def reserve(self, size: int) -> None:
        """Have room for one answer of this size more, within 4 MiB; not in a cycle."""
    def take(self) -> bytes:
        """Return all entries, and forget them."""
    def calls(self) -> list[int]:
        """Return how often each source was asked, in the order of their opening."""

class Outside:
    """Something outside that a module asks: its answers are recorded, and played again.

    What a driver reads goes through here, and so the module's log can be verified::

        class Scale:
            def __init__(self, path: str) -> None:
                self._outside = Outside(f"scale {path}")
                self._fd = self._outside.ask(os.open, path, os.O_RDONLY)

            def grams(self) -> float:
                return self._outside.ask(self._read)

    Args:
        name: Of what it is; the replay must open the same.
        room: Bytes of its longest answer, where that may be more than some thousand.
    """

    name: str
    number: int
    calls: int
    def __init__(self, name: str, *, room: int = 0) -> None: ...
    @property
    def plays(self) -> bool:
        """Whether answers come from a log, and nothing outside is touched."""
    def ask(self, call: Callable[..., _T], *args: object, default: object = ...) -> _T:
        """Return what `call` answers; in a replay, what it answered then.

        Exceptions are recorded and raised again.

        Args:
            call: Does it. It is not called in a replay.
            args: For it.
            default: An answer that is not worth a record, such as ``b""`` of a line
                where nothing has arrived.

        Raises:
            DeviceError: The answer is nothing that can be recorded: None, numbers,
                text, bytes, or a tuple, list or dictionary of these.
        """
