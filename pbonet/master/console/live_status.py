"""The live status of a run: a table that renews itself, or plain lines."""

from __future__ import annotations

import sys
from collections import deque
from typing import TYPE_CHECKING, Final, Protocol, Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pbonet.master.subsystem import Window
from pbonet.pbo import State

from . import render

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pbonet.master.subsystem import status_fields
    from pbonet.xm.net import Event, RtpuStatus, TaskStatus

_COLORS: Final = {"ON": "green", "OFF": "cyan", "ERROR": "red"}
_HEAD: Final = (
    *(
        "task",
        "rtpu",
        "state",
        "Hz",
        "of",
        "cycles",
        "missed",
        "failed",
        "CPU avg",
        "CPU max",
    ),
    *("CPU", "jitter max", "warn"),
)
_EVENTS: Final = 6
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
    return Screen() if sys.stdout.isatty() else Plain()


class Screen:
    """A table that renews itself, with the last events below it.

    Args:
        console: Where it is shown; standard output by default.
        fields: Fields of `status`, over the last second; none: those of a run.
        end: What ends it.
    """

    def __init__(
        self,
        console: Console | None = None,
        *,
        fields: Sequence[str] = (),
        end: str = "Ctrl-C turns everything off in order",
    ) -> None:
        self._console = console or Console()
        self._fields = fields
        self._end = end
        self._window = Window()
        self._events: deque[str] = deque(maxlen=_EVENTS)
        self._live = Live(
            console=self._console, auto_refresh=False, vertical_overflow="visible"
        )

    def say(self, line: str) -> None:
        """Print a line above the table."""
        self._console.print(line, highlight=False, markup=False)

    def show(self, passed: float, rtpus: list[RtpuStatus], events: list[Event]) -> None:
        """Renew the table."""
        self._events.extend(render.event(event) for event in events)
        below = [Text(line, style="yellow") for line in self._events]
        self._live.update(
            Group(self._table(passed, rtpus), *self._notes(rtpus), *below),
            refresh=True,
        )

    def _table(self, passed: float, rtpus: list[RtpuStatus]) -> Table:
        table = Table(box=None, header_style="bold", pad_edge=False)
        for name in ("task", *self._fields) if self._fields else _HEAD:
            left = name in {"task", "rtpu", "state", "rmod", "module"}
            table.add_column(name, justify="left" if left else "right", no_wrap=True)
        for status in (task for rtpu in rtpus for task in rtpu.tasks):
            now = self._window.rates(status)
            if self._fields:
                cells = (render.cell(name, now[name]) for name in self._fields)
                table.add_row(status.task, *cells)
            else:
                table.add_row(*_run_row(status, now))
        table.caption = f"{passed:.0f} s; {self._end}"
        return table

    def _notes(self, rtpus: list[RtpuStatus]) -> list[Text]:
        notes: list[Text] = []
        for rtpu in rtpus:
            load = f"{rtpu.rtpu}: {rtpu.scheduler} over {rtpu.backend}, tasks take "
            load += f"{self._window.load(rtpu.tasks):.1%} of the core"
            if rtpu.stalls:
                load += f", stood still {rtpu.stalls} times, {rtpu.stalled:.2g} s"
            notes.append(Text(load, style="dim"))
            notes += [
                Text(f"ILLEGAL {cause}", style="bold red") for cause in rtpu.illegal
            ]
            notes += [
                Text(f"{task.task}: {task.error}", style="red")
                for task in rtpu.tasks
                if task.state in {State.ERROR, State.NOT_CREATED}
            ]
        return notes

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()


def _run_row(
    status: TaskStatus, now: dict[str, status_fields.Value]
) -> Iterator[str | Text]:
    """Yield the cells of a task in the table of a run."""
    if status.state == State.NOT_CREATED:
        now = dict.fromkeys(now)
    yield status.task
    yield status.rtpu
    yield Text(status.state, style=_COLORS.get(status.state, "white"))
    yield render.cell("mezF", now["mezF"])
    yield render.cell("refF", now["refF"])
    yield from map(str, (status.cycle, status.miss, status.failed))
    yield from (render.cell(name, now[name]) for name in ("avgC", "maxC", "avgU"))
    yield render.seconds(status.jitter_max)
    yield str(status.warn)


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
            return (
                f"{status.task:15} {status.state} "
                f"after {status.cycle} cycles: {status.error}"
            )
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
