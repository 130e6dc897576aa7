"""Write what the documentation shows of a task's life, out of the rules themselves.

``python docs/draw_lifecycle.py`` renews ``lifecycle.svg`` and the table between the two
marks in ``lifecycle.md``; a test fails when they are not in step with
`pbonet.node.wire.lifecycle`.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.sax.saxutils import escape

from pbonet.node.wire import lifecycle
from pbonet.pbo import State

HERE = Path(__file__).parent
BEGIN = "<!-- the table below is written by draw_lifecycle.py -->\n"
END = "<!-- the table above is written by draw_lifecycle.py -->\n"

PLACES = {
    State.NOT_CREATED: (360, 44),
    State.OFF: (360, 215),
    State.ON: (90, 400),
    State.ERROR: (630, 400),
}
CENTRE = (360, 260)
HALF_WIDTH, HALF_HEIGHT = 64, 20
BEND = 30
LINE = 15
GAP = 16
LEVEL = 0.3
"""Below this the side of an arrow is above or below it, not left or right."""

Point = tuple[float, float]

HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 720 480" \
font-family="sans-serif" font-size="13">
<title>States of a task, and what leads from one to another</title>
<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" \
markerHeight="8" orient="auto"><path d="M0 0 10 5 0 10z" fill="#456"/></marker></defs>
<rect width="720" height="480" fill="white"/>
"""


def inserted(page: str) -> str:
    """Return `page` with the present table between its marks."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{lifecycle.table()}\n{END}{after}"


def figure() -> str:
    """Return the figure: four states, and an arrow for each way between two."""
    arrows = lifecycle.arrows()
    parts = [HEAD]
    for (start, end), labels in arrows.items():
        if start is end:
            parts.append(_loop(PLACES[start], labels))
        else:
            both = (end, start) in arrows
            parts.append(_arrow(PLACES[start], PLACES[end], labels, both=both))
    parts += [_box(state) for state in State]
    return "".join(parts) + "</svg>\n"


def _box(state: State) -> str:
    x, y = PLACES[state]
    return (
        f'<rect x="{x - HALF_WIDTH}" y="{y - HALF_HEIGHT}" width="{2 * HALF_WIDTH}" '
        f'height="{2 * HALF_HEIGHT}" rx="9" fill="#eef3f8" stroke="#456"/>\n'
        f'<text x="{x}" y="{y + 5}" text-anchor="middle" font-weight="bold">'
        f"{state}</text>\n"
    )


def _arrow(start: Point, end: Point, labels: list[str], *, both: bool) -> str:
    """Return a bent arrow: to its right if there is one back, else away from all."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.hypot(dx, dy)
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    side = (-dy / length, dx / length)
    out = side[0] * (middle[0] - CENTRE[0]) + side[1] * (middle[1] - CENTRE[1])
    bend = BEND if both or out >= 0 else -BEND
    knee = (middle[0] + bend * side[0], middle[1] + bend * side[1])
    first, last = _edge(start, knee), _edge(end, knee)
    out = math.copysign(1, bend)
    away = abs(bend) / 2 + GAP
    top = (middle[0] + away * out * side[0], middle[1] + away * out * side[1])
    slope = out * side[0]
    anchor = "middle" if abs(slope) < LEVEL else "end" if slope < 0 else "start"
    return _path(f"M{_at(first)} Q{_at(knee)} {_at(last)}") + _text(top, labels, anchor)


def _loop(place: Point, labels: list[str]) -> str:
    """Return an arrow below a state, back to itself."""
    x, y = place[0], place[1] + HALF_HEIGHT
    path = f"M{x + 20:.0f} {y:.0f} C{x + 45:.0f} {y + 48:.0f} "
    path += f"{x - 45:.0f} {y + 48:.0f} {x - 20:.0f} {y:.0f}"
    return _path(path) + _text((x + 46, y + 30), labels, "start")


def _edge(place: Point, towards: Point) -> Point:
    """Return where the line from a state's middle leaves its box."""
    dx, dy = towards[0] - place[0], towards[1] - place[1]
    scale = min(
        HALF_WIDTH / abs(dx) if dx else math.inf,
        HALF_HEIGHT / abs(dy) if dy else math.inf,
    )
    return (place[0] + scale * dx, place[1] + scale * dy)


def _path(path: str) -> str:
    return (
        f'<path d="{path}" fill="none" stroke="#456" stroke-width="1.5" '
        'marker-end="url(#tip)"/>\n'
    )


def _text(place: Point, labels: list[str], anchor: str) -> str:
    x = place[0]
    y = place[1] - LINE * (len(labels) - 1) / 2 + 4
    return "".join(
        f'<text x="{x:.0f}" y="{y + LINE * row:.0f}" text-anchor="{anchor}">'
        f"{escape(label)}</text>\n"
        for row, label in enumerate(labels)
    )


def _at(point: Point) -> str:
    return f"{point[0]:.0f} {point[1]:.0f}"


def main() -> None:
    """Renew both files."""
    page = HERE / "lifecycle.md"
    page.write_text(inserted(page.read_text(encoding="utf-8")), encoding="utf-8")
    (HERE / "lifecycle.svg").write_text(figure(), encoding="utf-8")


if __name__ == "__main__":
    main()
