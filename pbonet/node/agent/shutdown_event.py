"""The event that ends an agent; a signal may set it."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import time


class Ending:
    """An event that signal handlers may set, even during its `wait`.

    The kernel may deliver a signal to a thread of zenoh, and then nothing interrupts
    the main thread. So a signal also writes to a pipe, see `heed_signals`: the waiting
    thread wakes up, and Python runs the handler.
    """

    def __init__(self) -> None:
        self._hears, self._rings = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self._come = False

    def __del__(self) -> None:
        """Close the pipe; the event can no longer be set."""
        os.close(self._hears)
        os.close(self._rings)

    def heed_signals(self) -> None:
        """Let every signal of this process wake `wait`; for the main thread."""
        signal.set_wakeup_fd(self._rings, warn_on_full_buffer=False)

    def set(self) -> None:
        """Set the event."""
        self._come = True
        with contextlib.suppress(BlockingIOError):  # the pipe is already full
            os.write(self._rings, b"!")

    def clear(self) -> None:
        """Clear the event."""
        self._come = False

    def is_set(self) -> bool:
        """Return whether it is set."""
        return self._come

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, for at most `timeout` seconds; return whether it is.

        For one thread only: a second one would not be woken.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while not self._come:
            left = None if end is None else max(end - time.monotonic(), 0.0)
            if not select.select([self._hears], [], [], left)[0]:
                break
            with contextlib.suppress(BlockingIOError):
                os.read(self._hears, select.PIPE_BUF)
        return self._come
