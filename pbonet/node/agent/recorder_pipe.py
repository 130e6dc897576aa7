"""Messages to a recorder: kept while its pipe is full, sent by a thread."""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

MOST: Final = 8 << 20
"""Bytes that are kept; what comes beyond is counted. A pipe itself takes 64 KiB."""
STUCK: Final = 10.0
"""Seconds for which a reader may take nothing while something waits for it."""


class RecorderPipe:
    """Frames for a reader that may be slow, may end, and may be replaced.

    Args:
        unfit: Called with how many frames found no room, once there is room again.
        stuck: Called when the reader takes nothing any more.
    """

    def __init__(self, unfit: Callable[[int], None], stuck: Callable[[], None]) -> None:
        self._unfit = unfit
        self._stuck = stuck
        self._frames: deque[bytes] = deque()
        self._bytes = 0
        self._dropped = 0
        self._reader = 0
        """The number of the present reader: 1, 2, ..."""
        self._over = False
        self._changed = threading.Condition()

    def put(self, frame: bytes) -> None:
        """Pass something on; never waits."""
        with self._changed:
            if self._over:
                return
            if self._bytes + len(frame) > MOST:
                self._dropped += 1
                return
            self._frames.append(frame)
            self._bytes += len(frame)
            self._changed.notify_all()

    def begin(self, fd: int) -> None:
        """Feed another reader, from the first frame on that none took whole.

        Args:
            fd: A pipe to it, which is closed at the end.
        """
        os.set_blocking(fd, False)
        with self._changed:
            self._reader += 1
            reader = self._reader
        threading.Thread(
            target=self._feed, args=(fd, reader), name="pbonet feed", daemon=True
        ).start()

    def leave(self) -> None:
        """Close the reader's pipe now; what is kept waits for another reader."""
        with self._changed:
            self._reader += 1
            self._changed.notify_all()

    def end(self) -> None:
        """Take nothing more; the pipe is closed when the reader has taken the rest."""
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _feed(self, fd: int, reader: int) -> None:
        try:
            while (frame := self._next(reader)) is not None:
                if not self._write(fd, frame):
                    return
                self._took(frame, reader)
        finally:
            os.close(fd)

    def _next(self, reader: int) -> bytes | None:
        """Wait for a frame; None: there is none to come for this reader."""
        with self._changed:
            while self._reader == reader and not self._frames and not self._over:
                self._changed.wait()
            if self._reader != reader or not self._frames:
                return None
            return self._frames[0]

    def _took(self, frame: bytes, reader: int) -> None:
        with self._changed:
            if self._reader != reader:
                return  # the next one is given it again
            self._frames.popleft()
            self._bytes -= len(frame)
            dropped, self._dropped = self._dropped, 0
        if dropped:
            self._unfit(dropped)

    def _write(self, fd: int, frame: bytes) -> bool:
        """Write a frame whole; False when the reader has ended or is stuck."""
        rest = memoryview(frame)
        waiting = select.poll()
        waiting.register(fd, select.POLLOUT)
        while rest:
            if not waiting.poll(STUCK * 1000):
                self._stuck()
                return False
            try:
                rest = rest[os.write(fd, rest) :]
            except BlockingIOError:
                continue
            except OSError:
                return False  # it has ended
        return True
