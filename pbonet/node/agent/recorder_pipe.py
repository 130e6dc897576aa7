"""Messages to a recorder: buffered while its pipe is full, sent by a thread."""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

MOST: Final = 8 << 20
"""Maximum bytes in the buffer; frames beyond it are counted. The pipe holds 64 KiB."""
STUCK: Final = 10.0
"""Seconds without progress after which a reader counts as stuck."""


class RecorderPipe:
    """Frames for a reader that may be slow, may end, and may be replaced.

    Args:
        unfit: Called with the number of dropped frames, when there is room again.
        stuck: Called when the reader is stuck.
    """

    def __init__(self, unfit: Callable[[int], None], stuck: Callable[[], None]) -> None:
        self._unfit = unfit
        self._stuck = stuck
        self._frames: deque[bytes] = deque()
        self._bytes = 0
        self._dropped = 0
        self._reader = 0
        """The number of the current reader: 1, 2, ..."""
        self._over = False
        self._changed = threading.Condition()

    def put(self, frame: bytes) -> None:
        """Add a frame; never waits."""
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
        """Send to a new reader, starting with the first frame not received whole.

        Args:
            fd: The write end of its pipe, which is closed at the end.
        """
        os.set_blocking(fd, False)
        with self._changed:
            self._reader += 1
            reader = self._reader
        threading.Thread(
            target=self._feed, args=(fd, reader), name="pbonet feed", daemon=True
        ).start()

    def leave(self) -> None:
        """Close the reader's pipe now; the buffer is kept for another reader."""
        with self._changed:
            self._reader += 1
            self._changed.notify_all()

    def end(self) -> None:
        """Accept no more frames; the pipe is closed when the rest has been read."""
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
        """Wait for a frame; None if this reader gets no more."""
        with self._changed:
            while self._reader == reader and not self._frames and not self._over:
                self._changed.wait()
            if self._reader != reader or not self._frames:
                return None
            return self._frames[0]

    def _took(self, frame: bytes, reader: int) -> None:
        with self._changed:
            if self._reader != reader:
                return  # the next reader gets it again
            self._frames.popleft()
            self._bytes -= len(frame)
            dropped, self._dropped = self._dropped, 0
        if dropped:
            self._unfit(dropped)

    def _write(self, fd: int, frame: bytes) -> bool:
        """Write a whole frame; return False if the reader has ended or is stuck."""
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
                return False  # the reader has ended
        return True
