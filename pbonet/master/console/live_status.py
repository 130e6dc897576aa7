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
    from pbonet.xm.net import Event, RtpuStatus

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
    """A table that renews itself, with the last events below it."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console()
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
        for name in _HEAD:
            left = name in {"task", "rtpu", "state"}
            table.add_column(name, justify="left" if left else "right", no_wrap=True)
        for status in (task for rtpu in rtpus for task in rtpu.tasks):
            now = self._window.rates(status)
            if status.state == State.NOT_CREATED:
                now = dict.fromkeys(now)
            table.add_row(
                status.task,
                status.rtpu,
                Text(status.state, style=_COLORS.get(status.state, "white")),
                render.cell("mezF", now["mezF"]),
                render.cell("refF", now["refF"]),
                str(status.cycle),
                str(status.miss),
                str(status.failed),
                render.cell("avgC", now["avgC"]),
                render.cell("maxC", now["maxC"]),
                render.cell("avgU", now["avgU"]),
                render.seconds(status.jitter_max),
                str(status.warn),
            )
        table.caption = f"{passed:.0f} s; Ctrl-C turns everything off in order"
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


class Plain:
    """Lines for a log: messages, each event, and a line per task now and then."""

    def __init__(self) -> None:
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
        self._next += _PLAIN_PERIOD
        for status in (task for rtpu in rtpus for task in rtpu.tasks):
            if status.state == State.NOT_CREATED:
                self.say(
                    f"{passed:6.1f} s  {status.task:15} {status.state} "
                    f"after {status.cycle} cycles: {status.error}"
                )
                continue
            now = self._window.rates(status)
            self.say(
                f"{passed:6.1f} s  {status.task:15} {status.state:5} "
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
