"""A sequence of jobs within a run: beside the display, or in virtual time."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Final

from pbonet.master.subsystem import (
    STOPPED_ELSEWHERE as STOPPED_ELSEWHERE,  # noqa: PLC0414 - a run takes it from here
    Phase,
    Sequencer,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from threading import Event

    from pbonet.master.subsystem import SequenceState, Subsystem

_END_TIME: Final = 10.0
"""Seconds that the thread may take to end after the run has ended."""


class SequenceThread:
    """Runs the sequence of a subsystem beside the display of a run.

    Args:
        subsystem: The subsystem; it is open.
        limit: Seconds after which it is aborted; None: never.
        say: Shows a line.
    """

    def __init__(
        self, subsystem: Subsystem, limit: float | None, say: Callable[[str], object]
    ) -> None:
        self._sequencer = Sequencer(subsystem, limit=limit, told=_Steps(say))
        self._error = ""
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def state(self) -> SequenceState:
        """Where it is."""
        return self._sequencer.state

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def _run(self) -> None:
        try:
            self._sequencer.run()
        except Exception as error:  # noqa: BLE001 - the run reports it
            self._error = str(error) or type(error).__name__

    def over(self, interrupted: Event) -> str:
        """Return why the run is over; empty: it is not.

        Args:
            interrupted: An interrupt: the sequence goes to its safe job.
        """
        if interrupted.is_set():
            interrupted.clear()
            self._sequencer.abort("interrupted")
        return "" if self._thread.is_alive() else reason(self.state)

    def end(self) -> None:
        """Give it up if it still runs; the run has ended for another reason."""
        if self._thread.is_alive():
            self._sequencer.give_up()
            self._thread.join(_END_TIME)

    def faults(self) -> list[str]:
        """Return what went wrong."""
        return faults(self.state)


class _Steps:
    """Shows each step when it begins, and each error.

    Args:
        say: Shows a line.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._shown = (0, 0)

    def __call__(self, state: SequenceState) -> None:
        """Show what is new in a state."""
        if state.failed > self._shown[1]:
            self._say(f"step {state.step or 'none'}: {state.errors[-1]}")
        if state.count > self._shown[0]:
            label = "" if state.step == state.job else f", {state.step}"
            kind = " (the safe job)" if state.safe else ""
            self._say(f"step {state.count}{label}: job {state.job} is ON{kind}")
        self._shown = (state.count, state.failed)


def in_virtual_time(
    subsystem: Subsystem,
    limit: float | None,
    say: Callable[[str], object],
    interrupted: Event,
) -> SequenceState:
    """Run the sequence of a subsystem in virtual time; return how it has ended.

    Args:
        subsystem: The subsystem; it is open.
        limit: Seconds of virtual time after which it is aborted; None: never.
        say: Shows a line.
        interrupted: An interrupt: the sequence goes to its safe job.
    """
    return Sequencer(
        subsystem, limit=limit, told=_Steps(say), aborted=interrupted
    ).run()


def reason(state: SequenceState) -> str:
    """Return in a few words how a sequence has ended."""
    text = f": {state.text}" if state.text else ""
    return f"{state.phase.value}{text}"


def faults(state: SequenceState) -> list[str]:
    """Return what makes the run of a sequence a failure."""
    if state.phase is Phase.DONE:
        return []
    found = [f"the sequence {state.name} was not done: {reason(state)}"]
    if state.safe and state.errors and state.errors[-1] not in state.text:
        found.append(f"in its safe job: {state.errors[-1]}")
    return found
