"""Twin of the illegal-configuration flag (flag.h)."""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING

from pbonet.svar import ALIVE, FULL

from .process import UNKNOWN, now_ns, process_start, space

if TYPE_CHECKING:
    from collections.abc import Iterator

CAUSES, CAUSES_EACH = 128, 64
_WORD = struct.Struct("<Q")
_CAUSE = struct.Struct("<q128s64s64s")
FLAG_BYTES = CAUSES * (_WORD.size + _CAUSE.size)
"""Words of all entries, then the entries."""
_IDLE, _FILLING, _UP = range(3)
_CHANGES, _UNLISTED = 8, 16
"""Places in the moving part."""


def identity(pid: int, start: int, space: int) -> int:
    """Return a process as an entry's word names it."""
    return start << 32 & UNKNOWN | (pid & 0x3FFFFF) << 10 | (space & 0xFF) << 2


def _me() -> int:
    return identity(os.getpid(), process_start(os.getpid()), space())


def _lives(word: int) -> bool:
    if word >> 2 & 0xFF != space() & 0xFF:
        return True
    now, then = process_start(word >> 10 & 0x3FFFFF), word >> 32
    unknown = now == UNKNOWN or then == UNKNOWN >> 32
    return now != 0 and (unknown or now & UNKNOWN >> 32 == then)


class Flag:
    """The part of a table that holds the flag."""

    map: memoryview
    live: int
    flag: int

    def _get(self, at: int) -> int:
        value: int = _WORD.unpack_from(self.map, at)[0]
        return value

    def _set(self, at: int, value: int) -> None:
        _WORD.pack_into(self.map, at, value)

    def _add(self, place: int) -> None:
        self._set(self.live + place, self._get(self.live + place) + 1)

    def count_change(self) -> None:
        """Count a change of the flag, or the end of a task."""
        self._add(_CHANGES)

    def _word(self, i: int) -> int:
        return self._get(self.flag + 8 * i)

    def _turn(self, i: int, word: int) -> None:
        self._set(self.flag + 8 * i, word)

    def _at(self, i: int) -> int:
        return self.flag + 8 * CAUSES + i * _CAUSE.size

    def _standing(self) -> Iterator[tuple[int, int, tuple[bytes, bytes, bytes], int]]:
        for i in range(CAUSES):
            if self._word(i) & 3 == _UP:
                time_ns, *texts = _CAUSE.unpack_from(self.map, self._at(i))
                cause, raiser, machine = (t.partition(b"\0")[0] for t in texts)
                yield i, self._word(i), (cause, raiser, machine), time_ns

    @property
    def changes(self) -> int:
        """Moves with every change of the flag."""
        return self._get(self.live + _CHANGES)

    @property
    def illegal(self) -> bool:
        """Whether the flag is up."""
        return any(True for _ in self._standing())

    @property
    def unlisted(self) -> int:
        """How many entries found no room."""
        return self._get(self.live + _UNLISTED)

    def causes(self) -> list[tuple[str, str, str, int]]:
        """Return every entry that stands."""
        found: list[tuple[str, str, str, int]] = []
        for _, _, texts, time_ns in self._standing():
            cause, raiser, machine = (t.decode(errors="replace") for t in texts)
            found.append((cause, raiser, machine, time_ns))
        return found

    def raise_illegal(self, cause: bytes, raiser: bytes, machine: bytes) -> int:
        """Add an entry."""
        texts, me = (cause[:127], raiser[:63], machine[:63]), _me()
        if any(who & ~3 == me and had == texts for _, who, had, _ in self._standing()):
            return 0
        words = [self._word(i) for i in range(CAUSES)]
        mine = sum(word & ~3 == me and word & 3 != _IDLE for word in words)
        for i, word in enumerate(words):
            left = word & 3 == _FILLING and not _lives(word)
            if mine < CAUSES_EACH and (word & 3 == _IDLE or left):
                self._turn(i, me | _FILLING)
                self._add(_CHANGES)
                _CAUSE.pack_into(self.map, self._at(i), now_ns(), *texts)
                self._turn(i, me | _UP)
                self._add(_CHANGES)
                return 0
        self._add(_UNLISTED)
        return FULL

    def clear_illegal(self, cause: bytes, raiser: bytes, machine: bytes) -> int:
        """Take entries away."""
        wanted = cause[:127], raiser[:63], machine[:63]
        found = [
            (i, word & ~3 == _me() or not _lives(word))
            for i, word, texts, _ in self._standing()
            if all(w in {b"", t} for w, t in zip(wanted, texts, strict=True))
        ]
        for i, ours in found:
            if ours:
                self._turn(i, _IDLE)
        self._add(_CHANGES)
        count = sum(ours for _, ours in found)
        return ALIVE if found and not count else count

    def forget(self, who: int) -> None:
        """Take away what a dead process raised."""
        for i, word, _, _ in self._standing():
            if word & ~3 == who and not _lives(word):
                self._turn(i, _IDLE)
        self._add(_CHANGES)
