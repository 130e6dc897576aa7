r"""Ctrl-C, SIGTERM and SIGHUP in a command that undoes what it began when it fails.

The first one ends the command, and begins the undoing. Python would end that at the
second one, with tasks that are created or ON; here each further one only shows what is
waited for. A terminal that is closed (SIGHUP) begins the undoing as well, unless the
program was started by `nohup`. SIGQUIT (Ctrl-\) ends the process at once, as ever.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from typing import TYPE_CHECKING, Any, Final, Self

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

_DEFAULTS: Final = (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGTERM, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
)
"""Signals with the handlers that end a program; of others the program takes care."""


class InterruptsInTurn:
    """Have a block ended by the first interrupt, and its undoing by none.

    Args:
        what: What is undone, or ended, for messages.
        left: What to do about what is left if the process is ended at once.
        awaited: Returns what is waited for.
        first: Whether an interrupt ends the block; otherwise none does.
        idle: Whether it leaves interrupts as they are.
    """

    def __init__(
        self,
        what: str,
        left: str,
        awaited: Callable[[], str],
        *,
        first: bool = True,
        idle: bool = False,
    ) -> None:
        self._what = what
        self._left = left
        self._awaited = awaited
        self._first = first
        self._signals = () if idle else _DEFAULTS
        self._before: list[tuple[int, Any]] = []
        self._installed = False
        self._late = 0
        """A signal that came while handlers were exchanged."""
        self._ends = 0
        """SIGTERM or SIGHUP if it is carried out after the block."""

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number, handler in self._signals:
                if signal.getsignal(number) is handler:
                    self._before.append((number, handler))
                    signal.signal(number, self._take)
        self._installed = True
        if self._late:
            self.__exit__()
        return self

    def __exit__(self, kind: type[BaseException] | None = None, *_: object) -> None:
        """Put the handlers back: the one that raises an exception is the last."""
        self._installed = False
        for number, handler in reversed(self._before):
            signal.signal(number, handler)
        if self._late:
            signal.raise_signal(self._late)
        if self._ends and kind is None:
            raise SystemExit(128 + self._ends)

    def wait(self) -> None:
        """Let no interrupt end what follows."""
        self._first = False

    def _take(self, number: int, _: FrameType | None) -> None:
        if not self._installed:
            self._late = number
        elif not self._first:
            if number != signal.SIGINT:
                self._ends = self._ends or number
            awaited = self._awaited()
            _say(
                f"still {self._what}{awaited and f'; waits for {awaited}'}. "
                f"Ctrl-\\ ends this at once; {self._left}"
            )
        else:
            self._first = False
            _say(f"interrupted: {self._what}")
            if number == signal.SIGINT:
                raise KeyboardInterrupt
            raise SystemExit(128 + number)


def _say(text: str) -> None:
    """Write a line; a pipe that was closed, or a write under way, ends no undoing."""
    with contextlib.suppress(AttributeError, OSError, RuntimeError, ValueError):
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
