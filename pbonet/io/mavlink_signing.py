"""Signatures of MAVLink 2: the key of a link, and whether a frame was made with it.

A signed frame ends with the number of its link, a time of 48 bits in steps of 10 us
since 2015, and the first six bytes of SHA-256 over the key and all before them. A frame
that is not newer than the last one of its sender is refused, so that recorded
ones count for nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import time
from pathlib import Path

from pbonet.errors import DeviceError

from .mavlink_frames import SIGNED, V2

LENGTH = 13
_TIME = slice(-12, -6)
_YEAR_2015_S = 1_420_070_400
_MINUTE = 6_000_000
"""60 s in the steps of time stamps."""


def read_key(path: str) -> bytes:
    """Return the secret of a link: SHA-256 of the words in a file, as stations have it.

    Raises:
        DeviceError: The file cannot be read, is empty, or others may read it.
    """
    try:
        words = Path(path).read_bytes().strip()
        open_to_others = Path(path).stat().st_mode & 0o077
    except OSError as error:
        raise _unusable(path, os.strerror(error.errno or 0)) from None
    if open_to_others:
        raise _unusable(path, "other users may read it", f"chmod 600 {path}")
    if not words:
        raise _unusable(path, "it is empty")
    return hashlib.sha256(words).digest()


def _unusable(path: str, got: str, remedy: str = "") -> DeviceError:
    return DeviceError(
        "the key of the MAVLink link is not usable",
        where=str(Path(path).absolute()),
        got=got,
        remedy=remedy or "write the passphrase of the other end into it",
    )


def time_stamp() -> int:
    """Return the time that a signature begins with: steps of 10 us since 2015."""
    return (time.time_ns() - _YEAR_2015_S * 1_000_000_000) // 10_000


class Signatures:
    """Judges signed frames of one link.

    Args:
        secret: 32 bytes.
        begin: The time stamp now; frames of a sender not heard before are refused when
            they are more than a minute older.
    """

    def __init__(self, secret: bytes, begin: int) -> None:
        self._secret, self._begin = secret, begin
        self._last: dict[tuple[int, int, int], int] = {}

    def valid(self, frame: bytes, system: int, component: int) -> bool:
        """Return whether a frame was made with the key, and is new."""
        if frame[0] != V2 or not frame[2] & SIGNED:
            return False
        digest = hashlib.sha256(self._secret + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, bytes(frame[-6:])):
            return False
        stamp = int.from_bytes(frame[_TIME], "little")
        sender = frame[-LENGTH], system, component
        if stamp <= self._last.get(sender, self._begin - _MINUTE):
            return False
        self._last[sender] = stamp
        return True
