"""Answers a request that waits for other machines exactly once, even if they fail."""

from __future__ import annotations

import itertools
import threading
from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class CallOnce:
    """Functions to be called exactly once each: by their cause, or at the end."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._count = itertools.count()
        self._open: dict[int, Callable[[], None]] = {}
        self._over = False

    def make(self, done: Callable[[], None]) -> Callable[[], None] | None:
        """Return a function that calls `done` once; None after the end."""
        with self._guard:
            if self._over:
                return None
            n = next(self._count)
            self._open[n] = done
        return partial(self._keep, n)

    def _keep(self, n: int) -> None:
        with self._guard:
            done = self._open.pop(n, None)
        if done is not None:
            done()

    def end(self) -> list[Callable[[], None]]:
        """Return the functions not called yet, for the caller; accept no more."""
        with self._guard:
            self._over = True
            left = list(self._open.values())
            self._open.clear()
        return left
