"""A schedule as a chart: text for a terminal, SVG for a page (like Figure 6.1)."""

from __future__ import annotations

from functools import partial
from html import escape
from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from .outcome import Account, Outcome, Segment

UNIT_NS = 1_000_000
_COLOURS = ("#2f6f9f", "#c2702d", "#4c8a3f", "#8b5fa3", "#a34a4a", "#5f6d7a")
_MISS = "#c00000"


class Marks(Struct, frozen=True, kw_only=True):
    """The characters of a text chart."""

    full: str = "█"
    """The task had the core for the whole column."""
    part: str = "▌"
    """... for some of it."""
    low: str = "░"
    """... at a lowered criticality: its reserve was used up."""
    idle: str = "·"
    release: str = "╵"
    miss: str = "✗"


ASCII = Marks(full="#", part="+", low="-", idle=".", release="'", miss="x")
"""For terminals and logs without Unicode."""


def nice_unit(span_ns: int, columns: int) -> int:
    """Return the shortest time of 1, 2 or 5 by a power of ten that fits a column."""
    wanted = max(1, -(-span_ns // max(1, columns)))
    power = int("1".ljust(len(str(wanted)), "0"))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= wanted)


def as_text(
    outcome: Outcome,
    *,
    begin_ns: int | None = None,
    end_ns: int | None = None,
    columns: int = 72,
    unit_ns: int = 0,
    marks: Marks | None = None,
) -> str:
    """Return a schedule as lines of text, two for each task.

    The first line shows when the task had the core, the second its releases and the
    deadlines that passed unmet.

    Args:
        outcome: The schedule, with its segments.
        begin_ns: The first instant; None for the schedule's.
        end_ns: The last instant; None for the schedule's, or what fits.
        columns: The widest chart.
        unit_ns: Nanoseconds of a column; 0 for what makes it fit.
        marks: The characters.

    Raises:
        ValueError: The stretch is empty.
    """
    marks = marks or Marks()
    begin = outcome.start_ns if begin_ns is None else begin_ns
    end = outcome.end_ns if end_ns is None else end_ns
    if end <= begin:
        msg = f"there is nothing to show from {begin} ns to {end} ns"
        raise ValueError(msg)
    unit = unit_ns or nice_unit(end - begin, columns)
    count = min(columns, -(-(end - begin) // unit))
    end = min(end, begin + count * unit)
    used = _columns(outcome.segments, begin, end, unit, count)
    width = max(map(len, outcome.tasks), default=0)
    lines: list[str] = []
    for name, account in outcome.tasks.items():
        cells = used.get(name, [(0, False)] * count)
        row = "".join(_cell(taken, low, unit, marks) for taken, low in cells)
        lines.append(f"{name.rjust(width)} {row}")
        below = _row_of_marks(account, begin, unit, count, marks)
        lines.append(f"{' ' * width} {below}".rstrip())
    lines += _scale(begin, unit, count, width)
    key = (
        f"a column is {unit / UNIT_NS:g} ms; {marks.full} runs, {marks.low} runs in "
        f"time that others leave, {marks.release} release, {marks.miss} deadline missed"
    )
    return "\n".join([*lines, key])


def _cell(taken: int, low: bool, unit: int, marks: Marks) -> str:  # noqa: FBT001
    if not taken:
        return marks.idle
    if low:
        return marks.low
    return marks.full if 2 * taken > unit else marks.part


def _columns(
    segments: Iterable[Segment], begin: int, end: int, unit: int, count: int
) -> dict[str, list[tuple[int, bool]]]:
    """Return, by task, the time used in each column and whether it was at less."""
    base: dict[str, int] = {}
    table: dict[str, list[tuple[int, bool]]] = {}
    for segment in segments:
        top = base[segment.task] = max(base.get(segment.task, 0), segment.crit)
        if segment.end_ns <= begin or segment.start_ns >= end:
            continue
        row = table.setdefault(segment.task, [(0, False)] * count)
        first = max(segment.start_ns, begin)
        last = min(segment.end_ns, end)
        for column in range((first - begin) // unit, -(-(last - begin) // unit)):
            left = begin + column * unit
            share = min(last, left + unit) - max(first, left)
            taken, low = row[column]
            row[column] = (taken + share, low or segment.crit < top)
    return table


def _row_of_marks(
    account: Account, begin: int, unit: int, count: int, marks: Marks
) -> str:
    row = [" "] * count
    for instants, mark in (
        (account.releases_ns, marks.release),
        (account.misses_ns, marks.miss),
    ):
        for instant in instants:
            column = (instant - begin) // unit
            if 0 <= column < count:
                row[column] = mark
    return "".join(row)


def _scale(begin: int, unit: int, count: int, width: int) -> Iterator[str]:
    """Yield the line of numbers, in milliseconds, one every ten columns."""
    row = ""
    for column in range(0, count, 10):
        row = row.ljust(column) + f"{(begin + column * unit) / UNIT_NS:g}"
    yield f"{'ms'.rjust(max(width, 2))} {row}"


# -- SVG ------------------------------------------------------------------------------

_text = partial(escape, quote=False)
_LEFT, _TOP, _ROW, _BAR = 72.0, 28.0, 34.0, 16.0


def as_svg(
    outcome: Outcome,
    *,
    title: str = "",
    begin_ns: int | None = None,
    end_ns: int | None = None,
    width: int = 760,
) -> str:
    """Return a schedule as an SVG picture, one row for each task.

    Boxes are CPU time, pale where the task ran at a lowered criticality; ticks are
    releases, red crosses deadlines that passed unmet.

    Args:
        outcome: The schedule, with its segments.
        title: Above the rows.
        begin_ns: The first instant; None for the schedule's.
        end_ns: The last instant; None for the schedule's.
        width: Pixels.

    Raises:
        ValueError: The stretch is empty.
    """
    begin = outcome.start_ns if begin_ns is None else begin_ns
    end = outcome.end_ns if end_ns is None else end_ns
    if end <= begin:
        msg = f"there is nothing to show from {begin} ns to {end} ns"
        raise ValueError(msg)
    scale = (width - _LEFT - 16) / (end - begin)
    rows = {name: place for place, name in enumerate(outcome.tasks)}
    height = _TOP + _ROW * len(rows) + 28
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" '
        f'height="{height:g}" viewBox="0 0 {width} {height:g}" '
        'font-family="sans-serif" font-size="11">',
        f"<title>{_text(title or 'schedule')}</title>",
        f'<rect width="{width}" height="{height:g}" fill="#ffffff"/>',
        f'<text x="{_LEFT:g}" y="16" font-size="12">{_text(title)}</text>',
    ]
    parts += _bars(outcome.segments, rows, begin, end, scale)
    for name, place in rows.items():
        base = _TOP + _ROW * place + _BAR + 6
        parts.append(
            f'<text x="{_LEFT - 8:g}" y="{base - 4:.1f}" text-anchor="end">'
            f"{_text(name)}</text>"
            f'<line x1="{_LEFT:g}" x2="{width - 16}" y1="{base:.1f}" y2="{base:.1f}" '
            'stroke="#444444" stroke-width="0.7"/>'
        )
        parts += _instants(outcome.tasks[name], base, begin, end, scale)
    parts += _axis(begin, end, scale, height)
    return "\n".join([*parts, "</svg>", ""])


def _bars(
    segments: Sequence[Segment],
    rows: dict[str, int],
    begin: int,
    end: int,
    scale: float,
) -> Iterator[str]:
    top: dict[str, int] = {}
    for segment in segments:
        most = top[segment.task] = max(top.get(segment.task, 0), segment.crit)
        first, last = max(segment.start_ns, begin), min(segment.end_ns, end)
        if first >= last:
            continue
        place = rows[segment.task]
        opacity = "0.35" if segment.crit < most else "0.95"
        yield (
            f'<rect x="{_LEFT + (first - begin) * scale:.2f}" '
            f'y="{_TOP + _ROW * place + 6:.1f}" '
            f'width="{(last - first) * scale:.2f}" height="{_BAR:g}" '
            f'fill="{_COLOURS[place % len(_COLOURS)]}" fill-opacity="{opacity}"/>'
        )


def _instants(
    account: Account, base: float, begin: int, end: int, scale: float
) -> Iterator[str]:
    for instant in account.releases_ns:
        if begin <= instant <= end:
            x = _LEFT + (instant - begin) * scale
            yield (
                f'<line x1="{x:.2f}" x2="{x:.2f}" y1="{base - _BAR - 4:.1f}" '
                f'y2="{base:.1f}" stroke="#222222" stroke-width="0.8"/>'
            )
    for instant in account.misses_ns:
        if begin <= instant <= end:
            x = _LEFT + (instant - begin) * scale
            yield (
                f'<path d="M{x - 4:.2f} {base - 4:.1f}l8 8m0 -8l-8 8" '
                f'stroke="{_MISS}" stroke-width="2" fill="none"/>'
            )


def _axis(begin: int, end: int, scale: float, height: float) -> Iterator[str]:
    step = nice_unit(end - begin, 16)
    for instant in range(-(-begin // step) * step, end + 1, step):
        x = _LEFT + (instant - begin) * scale
        yield (
            f'<text x="{x:.1f}" y="{height - 8:g}" text-anchor="middle" '
            f'fill="#444444">{instant / UNIT_NS:g}</text>'
        )
    yield f'<text x="8" y="{height - 8:g}" fill="#444444">ms</text>'
