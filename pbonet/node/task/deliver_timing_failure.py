"""Delivers a timing failure to a module during its cycle, and records that."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.node import rt
from pbonet.pbo import Recovery, TimingFailure, line_of
from pbonet.ports import here

if TYPE_CHECKING:
    from types import CodeType

    from pbonet.outside import ModuleAnswers

    from .executor import Executor
    from .task_channel import SlotTime

_RECOVERIES = {
    Recovery.CONTINUE: rt.CONTINUE,
    Recovery.ABORT: rt.ABORT,
    Recovery.SKIP: rt.SKIP,
}


class TimingFailureDelivery:
    """Handler that the native loop calls with the kind of failure.

    Args:
        executor: Calls the module's handler.
        told: Records the kind, the interrupted line (empty: not in the module, whose
            method had not begun) or the method in C that has returned, the release, the
            requests of the handler, and its answer.
        time: The task's time.
        ours: Code of the runtime that calls the module.
    """

    def __init__(
        self,
        executor: Executor,
        told: ModuleAnswers,
        time: SlotTime,
        ours: set[CodeType],
    ) -> None:
        self._executor = executor
        self._told = told
        self._time = time
        self._ours = ours

    def __call__(self, kind: str) -> int:
        """Call the handler."""
        told, frame = self._told, here(1)
        amid = frame is not None and frame.f_code not in self._ours
        place = line_of(frame) if amid else ""
        if self._time.returned:
            place = f"the end of {self._time.returned}"
        came = kind, place, self._time.now
        told.timing.ask(lambda: came)
        told.handling = True
        try:
            answer = self._executor.timing_failure(TimingFailure(kind))
        finally:
            told.handling = False
        told.timing.ask(lambda: str(answer))
        return _RECOVERIES[answer]
