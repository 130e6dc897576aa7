"""The live status of a run as a table that renews itself, on a terminal."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, Self

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
            if text := render.stall_text(rtpu.stalls, rtpu.stalled, rtpu.stall_age):
                load += f", {text}"
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
