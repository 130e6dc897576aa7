"""Virtual time."""

from __future__ import annotations


class FakeClock:
    """A clock that a test advances.

    Args:
        now_ns: Nanoseconds at the start.
    """

    def __init__(self, now_ns: int = 1_000_000_000) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        """Return the time in nanoseconds, as ``time.monotonic_ns`` does."""
        return self.now_ns

    def advance(self, seconds: float) -> int:
        """Let `seconds` pass and return the new time in nanoseconds."""
        if seconds < 0:
            message = f"time does not go back, not even by {-seconds:g} s"
            raise ValueError(message)
        self.now_ns += round(seconds * 1e9)
        return self.now_ns
