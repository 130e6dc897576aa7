"""Recorded timing failures, reported to a module that is run again.

A failure interrupts a module between two instructions; on record is the line. The
handler is called again there, the first time that the line is reached. How far a loop
had come is unknown, so differences after that prove nothing.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Final

from pbonet.node.task import RAISED
from pbonet.outside import BrokenOffError, NotRecordedError
from pbonet.pbo import TimingFailure, line_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import FrameType

    from pbonet.node.task import Executor
    from pbonet.outside import ModuleAnswers, Player
    from pbonet.pbo import PythonWatch

    from ._outside import Time

_MOST_LINES: Final = 2_000_000
"""How many lines a cycle may take to the one at which its failure came."""


class HandlerError(BaseException):
    """The handler of timing failures does something else than was recorded.

    No `Exception`, so that no module catches it.
    """


class Failing:
    """The timing failures of one task.

    Args:
        told: The recorded information about the task.
        player: The recorded answers; None: older logs have none.
        executor: Calls the handler.
        source: The time that the module gets.
        watch: Delays failures.
    """

    def __init__(
        self,
        told: ModuleAnswers,
        player: Player | None,
        executor: Executor,
        source: Time,
        watch: PythonWatch,
    ) -> None:
        self._told = told
        self._player = player
        self._executor = executor
        self._source = source
        self._watch = watch
        self._came: tuple[TimingFailure, str, int] | None = None
        self._lines = 0
        self.unsure = ""
        """Why what differs from here on may be no fault of the module's."""

    def run(self, call: Callable[..., object], *args: object) -> None:
        """Call a method, and its handler where failures came amid it.

        Raises:
            HandlerError: The handler does something else.
            NotRecordedError: It cannot be said where it is to be called.
        """
        if not self._next():
            call(*args)
            return
        while self._came is not None and not self._came[1]:
            self._call_handler()  # it came before the method had begun
        try:
            self._watched(call, *args)
        except BrokenOffError:
            self.rest()
            raise
        self.rest()

    def rest(self) -> None:
        """Call the handler for a failure that is not reported yet."""
        while self._next():
            self._call_handler()

    def aborted(self, cycle: int, calls: Sequence[int]) -> None:
        """Go where an aborted cycle was left: its handler has answered, no more."""
        self.rest()
        self.unsure = (
            f"the cycle after cycle {cycle} was aborted, and what it had done by then "
            "is not recorded"
        )
        if self._player is not None:
            self._player.go_on(calls)

    def _next(self) -> bool:
        """Take the next failure that is on record; return whether there is one."""
        timing = self._told.timing
        if self._came is None and self._player is not None:
            if not self._player.waits(timing):
                return False
            kind, place, now = timing.ask(_none)
            self._came = TimingFailure(kind), place, now
        return self._came is not None

    def _call_handler(self) -> None:
        """Call the handler, which must return the recorded answer."""
        assert self._came is not None  # noqa: S101 - the caller has checked
        (kind, place, now), self._came = self._came, None
        if place:
            self.unsure = (
                f"a timing failure ({kind}) came at {place}, and how often that line "
                "had been run by then is not recorded"
            )
        before, self._source.release = self._source.release, now
        self._told.handling = True
        try:
            answer = str(self._executor.timing_failure(kind))
        except RAISED as error:
            text = f"timing_failure raised {type(error).__name__}: {error}"
            raise HandlerError(text) from None
        finally:
            self._told.handling = False
            self._source.release = before
        if (then := self._told.timing.ask(str)) != answer:
            text = f"timing_failure answers {answer}, recorded {then}"
            raise HandlerError(text)

    def _watched(self, call: Callable[..., object], *args: object) -> None:
        """Call a method, and its handler at the line at which a failure came."""
        if self._came is None:
            call(*args)
            return
        self._lines = 0
        before = sys.gettrace()
        sys.settrace(self._on_line)
        try:
            call(*args)
        finally:
            sys.settrace(before)

    def _on_line(self, frame: FrameType, event: str, _arg: object) -> Any:  # noqa: ANN401
        if event != "line" or self._came is None:
            return self._on_line if self._came is not None else None
        self._lines += 1
        place = self._came[1]
        if self._lines > _MOST_LINES:
            message = f"its timing failure came at {place}, where it does not get now"
            raise NotRecordedError(message)
        if f":{frame.f_lineno} in " in place and _tail(line_of(frame)) == _tail(place):
            self._watch.when_free(self._due_here)
        return self._on_line

    def _due_here(self) -> None:
        if self._came is not None:
            self._call_handler()
            self._next()


def _none() -> tuple[str, str, int]:
    """Take the place of the recorded one."""
    raise AssertionError


def _tail(place: str) -> str:
    """Return a place without its folder, which may be another one now."""
    return place.rpartition("/")[2]
