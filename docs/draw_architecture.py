"""Draw the processes of two machines from the text in ``architecture.txt``.

``python docs/draw_architecture.py`` renews ``architecture.svg``; a test fails when the
figure is not what this script draws.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

HERE = Path(__file__).parent
WIDTH, HEIGHT = 1240, 800
LINE = 16
MACHINE = 620
"""Distance between the two machines."""

NAMES = (
    {"MACHINE": "machine A", "AGENT": "arm0", "TASK1": "pid", "TASK2": "puma"},
    {"MACHINE": "machine B", "AGENT": "vision0", "TASK1": "camera", "TASK2": "track"},
)
FILLS = {
    "frame": ("#fafbfc", "#9ab"),
    "process": ("#eef3f8", "#456"),
    "memory": ("#fdf4e3", "#a73"),
}
HEAD = f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" \
font-family="sans-serif" font-size="13">
<title>Processes, threads, shared memory, sockets and keys of two machines</title>
<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" \
markerHeight="8" orient="auto-start-reverse"><path d="M0 0 10 5 0 10z" fill="#456"/>\
</marker></defs>
<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>
"""


class Item(NamedTuple):
    """One line of a diagram."""

    kind: str
    words: list[str]
    texts: list[str]


def items(diagram: str) -> list[Item]:
    """Return the lines of `diagram`, frames before arrows before boxes."""
    found: list[Item] = []
    for line in diagram.strip().splitlines():
        first, *texts = (part.strip() for part in line.split("|"))
        kind, _name, *words = first.split()
        found.append(Item(kind, words, texts))
    order = ("frame", "arrow", "process", "memory")
    return sorted(found, key=lambda item: order.index(item.kind))


def figure() -> str:
    """Return the figure."""
    text = (HERE / "architecture.txt").read_text(encoding="utf-8")
    _, _, rest = text.partition("[on each machine]\n")
    shared, _, between = rest.partition("[between the machines]\n")
    parts = [HEAD]
    for number, names in enumerate(NAMES):
        text = shared
        for word, name in names.items():
            text = text.replace(word, name)
        parts += [_draw(item, number * MACHINE) for item in items(text)]
    parts += [_draw(item, 0) for item in items(between)]
    return "".join(parts) + "</svg>\n"


def _draw(item: Item, shift: int) -> str:
    return (_arrow if item.kind == "arrow" else _box)(item, shift)


def _box(item: Item, shift: int) -> str:
    x, y, width, height = map(int, item.words)
    x += shift
    fill, stroke = FILLS[item.kind]
    drawn = (
        f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="8" '
        f'fill="{fill}" stroke="{stroke}"/>\n'
    )
    for row, text in enumerate(item.texts):
        weight = ' font-weight="bold"' if row == 0 else ""
        drawn += (
            f'<text x="{x + 10}" y="{y + 20 + LINE * row}"{weight}>'
            f"{escape(text)}</text>\n"
        )
    return drawn


def _arrow(item: Item, shift: int) -> str:
    *numbers, ends = item.words
    points = [int(number) for number in numbers]
    path = " ".join(
        f"{x + shift} {y}" for x, y in zip(points[::2], points[1::2], strict=True)
    )
    start = ' marker-start="url(#tip)"' if ends == "both" else ""
    drawn = (
        f'<polyline points="{path}" fill="none" stroke="#456" stroke-width="1.3" '
        f'marker-end="url(#tip)"{start}/>\n'
    )
    left, top, anchor, *label = item.texts[0].split()
    if not label:
        return drawn
    return drawn + (
        f'<text x="{int(left) + shift}" y="{top}" text-anchor="{anchor}" '
        f'font-size="11" fill="#345">{escape(" ".join(label))}</text>\n'
    )


def main() -> None:
    """Renew the figure."""
    (HERE / "architecture.svg").write_text(figure(), encoding="utf-8")


if __name__ == "__main__":
    main()
