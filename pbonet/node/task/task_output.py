"""Output that modules print: carried to the RTPU process without waiting.

In the task, file descriptors 1 and 2 are one non-blocking pipe. Python's own streams
are replaced by a writer that drops what does not fit and reports how much; output of C
code that does not fit is lost. In the RTPU process, `Lines` splits the output into
lines and turns a bounded number of them into events.
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
    """A text stream to a non-blocking pipe that drops output instead of waiting."""

    def __init__(self, fd: int) -> None:
        super().__init__()
        self._fd = fd
        self._part = ""
        self._dropped = 0

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the pipe's descriptor."""
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
        """Write the kept text, which has no newline."""
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
    """Make Python's streams drop instead of wait; 1 and 2 are the pipe already."""
    os.set_blocking(1, False)
    sys.stdout = DroppingWriter(1)
    sys.stderr = DroppingWriter(2)


class Lines:
    """Splits a task's output into lines and passes a bounded number of them on.

    Args:
        tell: Called with one line, or with a note about suppressed lines.
        clock_ns: CLOCK_MONOTONIC in nanoseconds.
        budget: Limits the number of lines.
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
        """Whether the last line was passed before its newline came."""

    def feed(self, data: bytes) -> None:
        """Process bytes read from the pipe."""
        *lines, self._part = (self._part + data).split(b"\n")
        if self._cut and lines and not lines[0]:
            del lines[0]  # the end of the line that was passed before
        self._cut = self._cut and not data
        if len(self._part) > 4 * LONGEST_LINE:
            lines.append(self._part)
            self._part, self._cut = b"", True
        for line in lines:
            self._pass(line)

    def close(self) -> None:
        """Pass the last line, and report how many were suppressed."""
        if self._part:
            self._pass(self._part)
            self._part = b""
        self._report_suppressed()

    def _pass(self, line: bytes) -> None:
        if not self._budget.take(self._clock_ns()):
            return
        self._report_suppressed()
        text = line.decode(errors="backslashreplace").rstrip("\r")
        if len(text) > LONGEST_LINE:
            text = f"{text[:LONGEST_LINE]} ... ({len(text) - LONGEST_LINE} more)"
        self._tell(text)

    def _report_suppressed(self) -> None:
        if count := self._budget.take_suppressed():
            self._tell(f"[{count} lines held back: printed too fast]")
