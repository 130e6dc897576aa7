"""The live status of a run: lines, or a table that renews itself (`live_screen`)."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final, Protocol, Self

from pbonet.master.subsystem import Window
from pbonet.pbo import State

from . import render

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.xm.net import Event, RtpuStatus, TaskStatus

_PLAIN_PERIOD: Final = 5.0


class View(Protocol):
    """Shows how a run goes."""

    def say(self, line: str) -> None:
        """Show a line."""

    def show(self, passed: float, rtpus: list[RtpuStatus], events: list[Event]) -> None:
        """Show the status; called a few times a second."""

    def __enter__(self) -> Self:
        """Begin."""
        ...

    def __exit__(self, *_: object) -> None:
        """End."""


def view(*, quiet: bool = False) -> View:
    """Return the view that suits standard output; a quiet one shows nothing there."""
    if quiet:
        return Quiet()
    return Terminal() if sys.stdout.isatty() else Plain()


class Terminal:
    """Lines while a job starts, and a table from the start of the context on.

    What draws the table is loaded then: before, it would delay the first cycle.
    """

    def __init__(self) -> None:
        self._view: View = Plain()

    def say(self, line: str) -> None:
        """Print a line, above the table if there is one."""
        self._view.say(line)

    def show(self, passed: float, rtpus: list[RtpuStatus], events: list[Event]) -> None:
        """Renew the table."""
        self._view.show(passed, rtpus, events)

    def __enter__(self) -> Self:
        from .live_screen import Screen

        self._view = Screen().__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._view.__exit__(*_)


class Plain:
    """Lines for a log: messages, each event, and a line per task now and then.

    Args:
        fields: Fields of `status`, over the last second; none: those of a run.
        period: Seconds between two lines of a task; 0: at each `show`.
    """

    def __init__(
        self, *, fields: Sequence[str] = (), period: float = _PLAIN_PERIOD
    ) -> None:
        self._fields = fields
        self._period = period
        self._window = Window()
        self._next = 0.0

    def say(self, line: str) -> None:
        """Print a line."""
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()

    def show(self, passed: float, rtpus: list[RtpuStatus], events: list[Event]) -> None:
        """Print the events, and every few seconds the status."""
        for event in events:
            self.say(render.event(event))
        if passed < self._next:
            return
        self._next += self._period
        for status in (task for rtpu in rtpus for task in rtpu.tasks):
            self.say(f"{passed:6.1f} s  {self._line(status)}")

    def _line(self, status: TaskStatus) -> str:
        """Return the figures of a task."""
        if status.state == State.NOT_CREATED:
            why = f": {status.error}" if status.error else ""
            return f"{status.task:15} {status.state} after {status.cycle} cycles{why}"
        now = self._window.rates(status)
        if self._fields:
            cells = (f"{name} {render.cell(name, now[name])}" for name in self._fields)
            return f"{status.task:15} {', '.join(cells)}"
        return (
            f"{status.task:15} {status.state:5} "
            f"{render.cell('mezF', now['mezF'])} of "
            f"{render.cell('refF', now['refF'])} Hz, {status.cycle} cycles, "
            f"{status.miss} missed, {status.failed} failed, "
            f"CPU {render.cell('avgU', now['avgU'])}"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return


class Quiet:
    """Messages and events on standard error; data goes to standard output."""

    def say(self, line: str) -> None:
        """Print a line on standard error."""
        sys.stderr.write(f"{line}\n")

    def show(self, passed: float, rtpus: list[RtpuStatus], events: list[Event]) -> None:
        """Print the events."""
        del passed, rtpus
        for event in events:
            self.say(render.event(event))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return
