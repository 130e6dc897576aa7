"""The end of an agent, which a signal may bring."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import time


class Ending:
    """An event that handlers of signals may set, for they may run amid its `wait`.

    The kernel may hand a signal to a thread of zenoh, and then nothing interrupts the
    main thread. So a signal rings too, see `heed_signals`: whoever waits looks up, and
    Python runs the handler.
    """

    def __init__(self) -> None:
        self._hears, self._rings = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self._come = False

    def __del__(self) -> None:
        """Close the pipe: nobody can set it any more."""
        os.close(self._hears)
        os.close(self._rings)

    def heed_signals(self) -> None:
        """Have every signal of this process ring; to be called by the main thread."""
        signal.set_wakeup_fd(self._rings, warn_on_full_buffer=False)

    def set(self) -> None:
        """Let it come."""
        self._come = True
        with contextlib.suppress(BlockingIOError):  # it rings already
            os.write(self._rings, b"!")

    def clear(self) -> None:
        """Take it back."""
        self._come = False

    def is_set(self) -> bool:
        """Tell whether it has come."""
        return self._come

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it has come, for so many seconds at most; return whether it has.

        For one thread: a second one would not hear the bell.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while not self._come:
            left = None if end is None else max(end - time.monotonic(), 0.0)
            if not select.select([self._hears], [], [], left)[0]:
                break
            with contextlib.suppress(BlockingIOError):
                os.read(self._hears, select.PIPE_BUF)
        return self._come
