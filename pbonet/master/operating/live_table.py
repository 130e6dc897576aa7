"""The live table of ``pbonet top`` on a terminal, and its rows elsewhere."""

from __future__ import annotations

import select
import sys
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import structs

from pbonet.errors import StateError, did_you_mean
from pbonet.master.console import Interrupts, render
from pbonet.master.subsystem import Subsystem, Window

from .subsystem_reader import SubsystemReader
from .table_rows import COLUMNS, Reading, all_rows, text_of
from .table_view import HELP, TableView

if TYPE_CHECKING:
    from pathlib import Path

    from prompt_toolkit.input import Input
    from rich.console import RenderableType
    from rich.live import Live

    from pbonet.master.configuration import Place

    from .table_rows import Column, Row

_KEYS: Final = 0.1
"""Seconds after which news are looked for though no key came."""
_SCREEN, _LINES = 0.5, 5.0
"""Seconds between two readings on a screen, and elsewhere."""
_BETWEEN: Final = 2
"""Blanks between two columns."""
_STYLES: Final = {"bad": "red", "off": "cyan", "": ""}
_FRAME: Final = 4
"""Lines of the screen that have no row: title, head, and what keys do."""
_NAMES: Final = {
    "c-m": "enter",
    "c-j": "enter",
    "c-i": "tab",
    "c-h": "backspace",
}
"""Keys as terminals send them, by their names here."""


def watch(
    path: str | Path,
    place: Place,
    *,
    sort: str,
    wanted: str,
    every: float | None,
    count: int | None,
    as_data: bool,
) -> None:
    """Show the tasks, RTPUs and variables of a subsystem until that is ended.

    Args:
        path: The subsystem's file.
        place: Where the subsystem is.
        sort: The column by which tasks are sorted; empty: none.
        wanted: Only rows with this text are shown.
        every: Seconds between two readings; None: as suits the output.
        count: How many readings are shown; None: until interrupted.
        as_data: Print JSON, one object a line.

    Raises:
        StateError: There is no such column.
        ConfigError: A file is missing or wrong.
        BrokenPipeError: The output is closed.
    """
    _must_be_column(sort)
    place = structs.replace(place, take_over=False, confirm=None)

    def make() -> Subsystem:
        return Subsystem(
            path,
            **place.arguments,
            kind="top",
            watch=True,
            partly=True,
            warned=lambda _: None,  # what does not answer has a row
        )

    make()  # faults of files are reported before anything is shown
    screen = sys.stdout.isatty() and sys.stdin.isatty() and not as_data
    reader = SubsystemReader(make, every or (_SCREEN if screen else _LINES))
    view = TableView(sort, wanted)
    interrupts = Interrupts(once=True)
    reader.start()
    try:
        with interrupts.caught():
            if screen:
                _on_screen(reader, view, interrupts, count)
            else:
                _as_lines(reader, view, interrupts, count, as_data=as_data)
    finally:
        reader.close()


def _must_be_column(sort: str) -> None:
    names = [column.name for column in COLUMNS["tasks"]]
    if sort and sort not in names:
        raise StateError(
            f"the table has no column {sort}",
            expected="one of " + ", ".join(names),
            remedy=did_you_mean(sort, names),
        )


# -- lines -----------------------------------------------------------------------------


def _as_lines(
    reader: SubsystemReader,
    view: TableView,
    interrupts: Interrupts,
    count: int | None,
    *,
    as_data: bool,
) -> None:
    """Print every reading: as a table of tasks, or as an object with all rows."""
    window, done = Window(), 0
    while not interrupts.wished.is_set() and done != count:
        if not reader.news.wait(_KEYS):
            continue
        reader.news.clear()
        if reader.failure is not None:
            raise reader.failure
        reading = reader.reading
        if reading is None:
            continue
        every = all_rows(reading, window)
        done += 1
        if as_data:
            text = msgspec.json.encode(_data(reading, every)).decode()
        else:
            text = _plain(view, reading, every)
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def _data(reading: Reading, every: dict[str, list[Row]]) -> dict[str, Any]:
    data: dict[str, Any] = {
        name: [
            {column.name: cell for column, cell in zip(columns, row.cells, strict=True)}
            for row in every[name]
        ]
        for name, columns in COLUMNS.items()
    }
    illegal = {cause for rtpu in reading.rtpus for cause in rtpu.illegal}
    return {
        "time": time.time(),
        **data,
        "flag": sorted(illegal),
        "silent": reading.silent,
        "warnings": reading.complaints,
    }


def _plain(view: TableView, reading: Reading, every: dict[str, list[Row]]) -> str:
    columns = COLUMNS[view.view]
    rows = [map(text_of, columns, row.cells) for row in view.shown(every[view.view])]
    lines = [render.table([one.name for one in columns], [[*row] for row in rows])]
    return "\n".join([*lines, *_notes(reading)])


def _notes(reading: Reading) -> list[str]:
    """Return the lines below the table: causes of the flag, and what is away."""
    causes = {cause: None for rtpu in reading.rtpus for cause in rtpu.illegal}
    notes = [f"ILLEGAL> {cause}" for cause in causes]
    told = dict.fromkeys((*reading.silent.values(), *reading.complaints))
    return [*notes, *(f"WARNING> {text}" for text in told)]


# -- screen ----------------------------------------------------------------------------


def _on_screen(
    reader: SubsystemReader, view: TableView, interrupts: Interrupts, count: int | None
) -> None:
    """Show the table in place of what the terminal has, until a key ends it."""
    from prompt_toolkit.input import create_input
    from rich.live import Live

    keys = create_input()
    window, last = Window(), None
    every: dict[str, list[Row]] = {name: [] for name in COLUMNS}
    with keys.raw_mode(), Live(screen=True, auto_refresh=False) as live:
        while not (view.ended or interrupts.wished.is_set()):
            if reader.news.is_set():
                reader.news.clear()
                if reader.failure is not None:
                    raise reader.failure
                if reader.reading is not None and reader.reading is not last:
                    last = reader.reading
                    every = all_rows(last, window)
                row, text = reader.explained
                if row is not None and row is view.asked:
                    view.explained = text
            live.update(_page(reader, view, every, live), refresh=True)
            if count is not None and reader.count >= count:
                break
            _take_keys(keys, view, reader)


def _take_keys(keys: Input, view: TableView, reader: SubsystemReader) -> None:
    """Take the keys that come within a moment."""
    ready, _, _ = select.select([keys.fileno()], [], [], _KEYS)
    pressed = keys.read_keys() if ready else keys.flush_keys()
    for one in pressed:
        before = view.asked
        name = str(getattr(one.key, "value", one.key))
        view.press(_NAMES.get(name, name))
        if view.asked is not None and view.asked is not before:
            reader.explain(view.asked)
    if keys.closed:
        view.ended = True


def _page(
    reader: SubsystemReader, view: TableView, every: dict[str, list[Row]], live: Live
) -> RenderableType:
    """Return what the screen shows."""
    from rich.console import Group
    from rich.text import Text

    if view.asked is not None:
        keys = "Esc goes back, up/down scroll"
        head = Text(f"{view.asked.kind} {view.asked.name}   ({keys})", "bold")
        text = Text(view.explained or "asking the agents ...")
        shown = [*text.wrap(live.console, live.console.width)]
        view.first = min(view.first, max(len(shown) - live.console.height + 1, 0))
        return Group(head, *shown[view.first :])
    reading = reader.reading
    if reading is None:
        return Text("asking the agents ...")
    lines = _notes(reading)
    most = max(live.console.height // 3, 1)
    if len(lines) > most:
        lines[most - 1 :] = [f"... and {len(lines) - most + 1} more"]
    notes = [Text(line, "red", no_wrap=True) for line in lines]
    room = live.console.height - _FRAME - len(notes)
    table = _table(view, every, max(room, 1), live.console.width)
    return Group(table, *notes, _foot(view))


def _foot(view: TableView) -> RenderableType:
    from rich.text import Text

    order = f"sorted by {view.sort or 'file'}{' reversed' * view.reverse}"
    wanted = f"  filter: {view.wanted}{'_' * view.typing}"
    return Text(
        f"{HELP}  [{order}]{wanted if view.wanted or view.typing else ''}", "dim"
    )


def _table(
    view: TableView, every: dict[str, list[Row]], room: int, width: int
) -> RenderableType:
    """Return the table: what fits of its rows, the selected one too, and of columns."""
    from rich.table import Table

    rows = view.shown(every[view.view])
    columns = _fitting(view, rows, width)
    left_out = len(COLUMNS[view.view]) - len(columns)
    title = f"{view.view} ({left_out} columns do not fit)" if left_out else view.view
    table = Table(box=None, header_style="bold", pad_edge=False, title=title)
    for column in columns:
        numeric = bool(column.field) or column.name in _COUNTS
        mark = ("^" if view.reverse else "v") * (column.name == view.sort)
        table.add_column(
            column.name + mark, justify="right" if numeric else "left", no_wrap=True
        )
    first = max(0, min(view.place - room // 2, len(rows) - room))
    for number, row in enumerate(rows[first : first + room], first):
        style = "reverse" if number == view.place else _STYLES[row.mark]
        table.add_row(*map(text_of, columns, row.cells), style=style)
    return table


def _fitting(view: TableView, rows: list[Row], width: int) -> list[Column]:
    """Return the first columns that a screen has room for, one at least."""
    columns = COLUMNS[view.view]
    texts = [
        [text_of(one, row.cells[n]) for row in rows] for n, one in enumerate(columns)
    ]
    left = width + _BETWEEN
    fitting: list[Column] = []
    for column, cells in zip(columns, texts, strict=True):
        mark = column.name == view.sort
        left -= max(map(len, [column.name + "v" * mark, *cells])) + _BETWEEN
        if left < 0 and fitting:
            break
        fitting.append(column)
    return fitting


_COUNTS: Final = {
    *("cycles", "missed", "failed", "stale", "flags", "warn", "core", "tasks", "on"),
    "stalls",
}
"""Columns of whole numbers."""
