"""The end of a run of a job: its outcome, and the signals that end it."""

from __future__ import annotations

import contextlib
import signal
import threading
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from . import summary

if TYPE_CHECKING:
    from collections.abc import Callable, Generator
    from types import FrameType

    from pbonet.log import Cycles

_FORCE: Final = 2
"""At this many interrupts everything is stopped at once."""


class Outcome(Struct, kw_only=True):
    """How a run went."""

    job: str
    seconds: float
    tasks: list[summary.TaskSummary]
    reason: str
    """Why it ended."""
    faults: list[str] = []
    """Faults at the end."""
    log: str = ""
    """The run's folder, with its log; empty when nothing was recorded here."""
    recording: Cycles | None = None
    """The same, to be read."""

    @property
    def status(self) -> int:
        """The exit status: 1 when a task ended in ERROR or something was left."""
        return int(bool(self.faults) or any(task.error for task in self.tasks))


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """Turn SIGINT and SIGTERM into a request to end; a second one stops at once.

    Args:
        once: A second one acts as if signals were not caught, which ends a module that
            hangs in this very process.
    """

    def __init__(self, *, once: bool = False) -> None:
        self.wished = threading.Event()
        self.count = 0
        self._once = once
        self._before: list[Any] = []
        self.force: Callable[[], object] | None = None
        """Called in a thread of its own by the second interrupt."""

    def take(self, _number: int, _frame: FrameType | None) -> None:
        """Take a signal."""
        self.count += 1
        self.wished.set()
        if self._once:
            self._give_back()
        if self.count == _FORCE and self.force is not None:
            threading.Thread(target=self.force, daemon=True).start()

    @contextlib.contextmanager
    def caught(self) -> Generator[None]:
        """Catch the signals, in the main thread; elsewhere they are its matter."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._before = [signal.signal(one, self.take) for one in _SIGNALS]
        try:
            yield
        finally:
            self._give_back()

    def _give_back(self) -> None:
        for one, handler in zip(_SIGNALS, self._before, strict=True):
            signal.signal(one, handler)
