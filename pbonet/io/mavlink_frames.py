"""MAVLink frames in a stream of bytes: found, checked, and not yet unpacked.

A frame begins with a mark, its length and flags, and ends with a check sum that also
covers a number of its kind of message, before a signature if it has one. Unpacking
takes longer than all of that, so it is left to those that need a message's values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

V1, V2 = 0xFE, 0xFD
"""The marks of both versions."""
SIGNED = 0x01
"""The flag of a frame that is signed; no other is known here."""
_SIGNATURE = 13
_HEAD = 3
"""Bytes that say how long a frame is."""
_LONGEST_HEADER = 10
_SHORTEST = 12
"""Bytes of a frame of MAVLink 2 without a message."""


class Frame(NamedTuple):
    """One frame whose check sum is right."""

    kind: int
    """The number of its message."""
    system: int
    component: int
    data: bytes


_new: Callable[..., Frame] = cast("Any", tuple).__new__
"""Makes a frame of a tuple, without the call of a function of Python."""


class FrameFinder:
    """Finds frames, and its way back after noise.

    Args:
        extras: A byte for each known kind of message, which its check sum covers.
        crc: The check sum of bytes (CRC-16/MCRF4XX).
        whole: Whether a frame never spans two calls.
    """

    def __init__(
        self, extras: Mapping[int, bytes], crc: Callable[[bytes], int], *, whole: bool
    ) -> None:
        self._extras, self._crc, self._whole = extras, crc, whole
        self._rest = b""
        self.damaged = 0
        """Stretches of noise and frames with a wrong check sum, of the last call."""

    def feed(self, data: bytes) -> Sequence[Frame]:
        """Return the frames that `data` completes, in order."""
        self.damaged = 0
        if not self._rest and (frame := self._alone(data)) is not None:
            return (frame,)
        return self._search(self._rest + data)

    def _alone(self, data: bytes) -> Frame | None:
        """Return the frame of MAVLink 2 that is all of `data`, as usual; else None."""
        size = len(data)
        if size < _SHORTEST or data[0] != V2 or (flags := data[2]) > SIGNED:
            return None
        crc_at = data[1] + _LONGEST_HEADER
        if size != crc_at + 2 + flags * _SIGNATURE:
            return None
        kind = data[7] | data[8] << 8 | data[9] << 16
        extra = self._extras.get(kind)
        if extra is None or self._crc(data[1:crc_at] + extra) != (
            data[crc_at] | data[crc_at + 1] << 8
        ):
            return None
        return _new(Frame, (kind, data[5], data[6], data))

    def _search(self, data: bytes) -> list[Frame]:
        at, end, found, noise = 0, len(data), list[Frame](), False
        while at < end:
            size = _size(data, at)
            if size and at + size > end and not self._whole:
                break  # its end is still to come
            fits = size and at + size <= end
            frame = self._check(data[at : at + size], size) if fits else None
            if frame is None:
                self.damaged += not noise
                noise, at = True, _next_mark(data, at + 1)
                continue
            noise, at = False, at + size
            if frame.system >= 0:
                found.append(frame)
        self._rest = data[at:]
        return found

    def _check(self, data: bytes, size: int) -> Frame | None:
        """Return a frame; None if it is none, system -1 if its kind is not known."""
        if data[0] == V2:
            kind = data[7] | data[8] << 8 | data[9] << 16
            system, component = data[5], data[6]
            crc_at = size - 2 - _SIGNATURE * (data[2] & SIGNED)
        else:
            kind, system, component, crc_at = data[5], data[3], data[4], size - 2
        extra = self._extras.get(kind)
        if extra is None:
            return Frame(kind, -1, component, b"") if self._whole else None
        crc = self._crc(data[1:crc_at] + extra)
        if data[crc_at] | data[crc_at + 1] << 8 != crc:
            return None
        return Frame(kind, system, component, data)


def _size(data: bytes, at: int) -> int:
    """Return the size of the frame that begins here; 0 if none does.

    A frame whose length has not come yet is one that is longer than what is there.
    """
    mark = data[at]
    if mark not in {V1, V2}:
        return 0
    if at + _HEAD > len(data):
        return _LONGEST_HEADER
    if mark == V1:
        return data[at + 1] + 8
    flags = data[at + 2]
    if flags & ~SIGNED:
        return 0
    return data[at + 1] + 12 + _SIGNATURE * flags


def _next_mark(data: bytes, at: int) -> int:
    """Return where the next mark is, else the end."""
    marks = [k for k in (data.find(V1, at), data.find(V2, at)) if k >= 0]
    return min(marks, default=len(data))
