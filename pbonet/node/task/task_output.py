"""Output that modules print: carried to the RTPU process without waiting.

In the task, file descriptors 1 and 2 are one non-blocking pipe. Python's own streams
are replaced by a writer that drops what does not fit and says how much; C code that
prints loses what does not fit. In the RTPU process, `Lines` cuts what arrives into
lines and lets a bounded number of them become events.
"""

from __future__ import annotations

import io
import os
import sys
from typing import TYPE_CHECKING

from pbonet.node.wire import LineBudget

if TYPE_CHECKING:
    from collections.abc import Callable

LONGEST_LINE = 1000
PIPE_BYTES = 1 << 18


class DroppingWriter(io.TextIOBase):
    """A text stream on a non-blocking pipe that drops rather than waits."""

    def __init__(self, fd: int) -> None:
        super().__init__()
        self._fd = fd
        self._part = ""
        self._dropped = 0

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the pipe's number."""
        return self._fd

    def write(self, text: str) -> int:
        """Write whole lines, keep the rest for later; return the length of `text`."""
        whole, newline, rest = (self._part + text).rpartition("\n")
        if not newline and len(rest) < LONGEST_LINE:
            self._part = rest
            return len(text)
        self._part = rest if newline else ""
        self._send(whole + newline if newline else rest)
        return len(text)

    def flush(self) -> None:
        """Write what is left without its newline."""
        if self._part:
            part, self._part = self._part, ""
            self._send(part)

    def _send(self, text: str) -> None:
        if self._dropped:
            text = f"[{self._dropped} characters lost: printed too fast]\n{text}"
        data = text.encode(errors="backslashreplace")
        try:
            sent = os.write(self._fd, data)
        except BlockingIOError:
            sent = 0
        except OSError:
            return  # the reader is gone
        self._dropped = len(data) - sent


def take_over() -> None:
    """Let Python's streams drop rather than wait; 1 and 2 are the pipe already."""
    os.set_blocking(1, False)
    sys.stdout = DroppingWriter(1)
    sys.stderr = DroppingWriter(2)


class Lines:
    """Cuts what a task printed into lines and passes a bounded number of them on.

    Args:
        tell: Called with one line, or with a note that lines were held back.
        clock_ns: CLOCK_MONOTONIC in nanoseconds.
        budget: How many lines pass.
    """

    def __init__(
        self,
        tell: Callable[[str], None],
        clock_ns: Callable[[], int],
        budget: LineBudget | None = None,
    ) -> None:
        self._tell = tell
        self._clock_ns = clock_ns
        self._budget = budget or LineBudget()
        self._part = b""
        self._cut = False
        """The last line was passed before its end came."""

    def feed(self, data: bytes) -> None:
        """Take bytes as they came out of the pipe."""
        *lines, self._part = (self._part + data).split(b"\n")
        if self._cut and lines and not lines[0]:
            del lines[0]  # no line of its own
        self._cut = self._cut and not data
        if len(self._part) > 4 * LONGEST_LINE:
            lines.append(self._part)
            self._part, self._cut = b"", True
        for line in lines:
            self._pass(line)

    def close(self) -> None:
        """Pass the last line, and say how many were held back."""
        if self._part:
            self._pass(self._part)
            self._part = b""
        self._tell_suppressed()

    def _pass(self, line: bytes) -> None:
        if not self._budget.take(self._clock_ns()):
            return
        self._tell_suppressed()
        text = line.decode(errors="backslashreplace").rstrip("\r")
        if len(text) > LONGEST_LINE:
            text = f"{text[:LONGEST_LINE]} ... ({len(text) - LONGEST_LINE} more)"
        self._tell(text)

    def _tell_suppressed(self) -> None:
        if count := self._budget.told():
            self._tell(f"[{count} lines held back: printed too fast]")
