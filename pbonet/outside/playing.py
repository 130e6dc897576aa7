"""Recorded inputs of a module from outside the table, given to it again."""

from __future__ import annotations

import struct
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from ._tape import BROKEN, LOST, RAISED, plays, use
from .answers import ALWAYS, NotRecordedError, unpack, unpack_error

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from ._tape import Outside, Tape

_ENTRY: Final = struct.Struct("<IIQ")
_CALL: Final = (1 << 56) - 1


class BrokenOffError(BaseException):
    """A command broke the wait off when it was recorded; it does so again."""


class Player:
    """Answers as a log has them, by source and call."""

    def __init__(self) -> None:
        self._heard: dict[tuple[int, int], tuple[int, bytes]] = {}
        self._sources: list[Outside] = []
        self.lost = False
        """Whether an entry did not fit; a missing record is then not a default."""

    def feed(self, data: bytes) -> bool:
        """Take entries of a tape; return whether some did not fit."""
        at, lost = 0, False
        while at < len(data):
            size, source, both = _ENTRY.unpack_from(data, at)
            at += _ENTRY.size
            kind = both >> 56
            lost = lost or kind == LOST
            self._heard[source, both & _CALL] = kind, data[at : at + size]
            at += -(-size // 8) * 8
        return lost

    def open(self, source: Outside) -> int:
        """Return the number of the next source, which must be this.

        Raises:
            NotRecordedError: Something else was opened then, or nothing.
        """
        self._sources.append(source)
        number = len(self._sources)
        found = self._heard.pop((number, 0), None)
        if found is not None and found[1].decode() == source.name:
            return number
        then = "nothing more" if found is None else found[1].decode()
        raise NotRecordedError(f"it opens {source.name}, but the log has {then}")

    def answers_of(self, name: str) -> list[Any]:
        """Return the first recorded answer of each source of a name, in their order.

        Exceptions are left out.
        """
        sources = [
            number
            for (number, call), (_, data) in self._heard.items()
            if not call and data.decode() == name
        ]
        first = [self._heard.get((number, 1)) for number in sources]
        return [unpack(*one) for one in first if one and one[0] != RAISED]

    def waits(self, source: Outside) -> bool:
        """Return whether the next call to a source is on record."""
        return (source.number, source.calls + 1) in self._heard

    def go_on(self, calls: Sequence[int]) -> None:
        """Bring each source to the number of calls that it had then (`Tape.calls`)."""
        for source, count in zip(self._sources, calls, strict=False):
            source.calls = count

    def answer(self, source: Outside, default: object) -> Any:  # noqa: ANN401
        """Return the recorded answer of a call, or raise its exception.

        Raises:
            NotRecordedError: Nothing is recorded, and there is no default.
            BrokenOffError: A command broke it off.
        """
        found = self._heard.pop((source.number, source.calls), None)
        if found is None:
            if default is ALWAYS or self.lost:
                why = "did not fit on the tape" if self.lost else "is not recorded"
                raise NotRecordedError(f"its input from {source.name} {why}")
            return default
        kind, data = found
        if kind == RAISED:
            raise unpack_error(data)
        if kind == BROKEN:
            raise BrokenOffError
        return unpack(kind, data)


@contextmanager
def using(tape: Tape | Player | None) -> Generator[None]:
    """Record on a tape, or play back, everything opened in this block."""
    before = use(tape)
    try:
        yield
    finally:
        use(before)


def refuse(what: str) -> None:
    """Return unless a log is run again, because this source is in no log.

    Raises:
        NotRecordedError: One is.
    """
    if plays():
        raise NotRecordedError(f"it uses {what}, whose results are in no log")
