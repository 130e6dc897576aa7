"""A call in a thread of its own: Ctrl-C ends the wait for it, and not the call."""

from __future__ import annotations

import contextvars
import threading
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


class InThread(Generic[T]):
    """A call that goes on in a thread, with the warnings of the caller's context.

    Args:
        call: What is called.
    """

    def __init__(self, call: Callable[[], T]) -> None:
        self._call = call
        self._results: list[T] = []
        self._errors: list[BaseException] = []
        self._over = threading.Event()  # a `join` that Ctrl-C ends takes it for ended
        run = contextvars.copy_context().run
        self._thread = threading.Thread(target=run, args=(self._run,))

    def begin(self) -> None:
        """Begin it; it may be under way or not if Ctrl-C ends this."""
        self._thread.start()

    def _run(self) -> None:
        try:
            self._results.append(self._call())
        except BaseException as error:  # noqa: BLE001 - the caller gets it
            self._errors.append(error)
        finally:
            self._over.set()

    def done(self, seconds: float) -> bool:
        """Wait for its end for some time; return whether it has come.

        One that has not begun by then never does.
        """
        return self._over.wait(seconds) or self._thread.ident is None

    def result(self) -> T:
        """Wait for its end; return its result, or raise its error."""
        self._over.wait()
        for error in self._errors:
            raise error
        return self._results[0]
