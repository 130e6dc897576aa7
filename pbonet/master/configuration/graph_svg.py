"""A graph as an SVG drawing that stands alone, in a file or in a page.

Every text is escaped, nothing is loaded, and there is no script. Colours follow the
light or dark setting of what shows it.
"""

from __future__ import annotations

import textwrap
from collections import defaultdict
from html import escape as escaped
from typing import TYPE_CHECKING

from .graph_layout import CHAR, ROW, Layout, kind, layout

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from .graph_layout import Band, Card, Net, Point
    from .subsystem_graph import Graph, GraphFault, GraphPort, GraphVariable

_COLOURS = 7
"""How many colours the wires of variables have in turn."""
_ROUND = 5
_EDGE = 14
"""Space around the drawing."""
_TEXT = 12
"""Height of a line of text."""
_LINE = 110
"""Characters of a line of a fault's text."""
_SIGNS = {"ON": "●", "OFF": "○", "ERROR": "✖", "NOT-CREATED": "◌"}
_STYLE = """
.pbonet{--paper:#fff;--ink:#1b1f24;--soft:#5c6670;--card:#fff;--edge:#8a949e;
--band:#f3f5f7;--bad:#c62828;--warn:#a15c00;--on:#1a7f37;--off:#0b7285;--con:#7d8790;
--w0:#0067a8;--w1:#c04a00;--w2:#00795a;--w3:#a83d80;--w4:#7a6200;--w5:#3f51b5;
--w6:#00838f;background:var(--paper);
font:11px ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace}
@media(prefers-color-scheme:dark){.pbonet{--paper:#15181c;--ink:#e8ebee;--soft:#a3adb7;
--card:#22272d;--edge:#7b8691;--band:#1c2025;--bad:#ff7b72;--warn:#e3b341;--on:#56d364;
--off:#39c5cf;--con:#8b949e;--w0:#58a6ff;--w1:#ff9b5e;--w2:#3fd6a4;--w3:#f28bc8;
--w4:#d6b93c;--w5:#a5b4ff;--w6:#4dd0e1}}
.pbonet text{fill:var(--ink)}
.pbonet .soft{fill:var(--soft)}
.pbonet .name{font-size:13px;font-weight:700}
.pbonet .title{font-size:15px;font-weight:700}
.pbonet .band{fill:var(--band);stroke:var(--edge);stroke-opacity:.5}
.pbonet .card{fill:var(--card);stroke:var(--edge);stroke-width:1.3}
.pbonet .spare{stroke-dasharray:6 4}
.pbonet .critical{stroke-width:2.6}
.pbonet .faulty{stroke:var(--bad);stroke-width:2.6}
.pbonet .doubtful{stroke:var(--warn);stroke-width:2.6}
.pbonet .bad{fill:var(--bad)}
.pbonet .warn{fill:var(--warn)}
.pbonet .ON{fill:var(--on)}.pbonet .OFF{fill:var(--off)}.pbonet .ERROR{fill:var(--bad)}
.pbonet .end{text-anchor:end}
.pbonet .halo{fill:none;stroke:var(--band);stroke-width:5}
.pbonet .over{paint-order:stroke;stroke:var(--band);stroke-width:6}
.pbonet .wire{fill:none;stroke-width:1.6}
.pbonet .constant{stroke-dasharray:1.5 3.5;stroke-linecap:round;stroke:var(--con)}
.pbonet .open{fill:var(--card)}
"""


def svg(graph: Graph, states: Mapping[str, str] | None = None) -> str:
    """Return the drawing of a graph.

    Args:
        graph: What is drawn.
        states: The state of each task, if it is to be shown.
    """
    shown = states or {}
    room = max((len(state_text(one)) + 1 for one in shown.values()), default=0)
    return _Drawing(graph, layout(graph, room=room), shown).text()


def state_text(state: str) -> str:
    """Return a state with its sign, which tells it without colours."""
    return f"{_SIGNS.get(state, '')} {state}".strip()


class _Drawing:
    """The parts of a drawing, and what they look up."""

    def __init__(self, graph: Graph, places: Layout, states: Mapping[str, str]) -> None:
        self._graph = graph
        self._places = places
        self._states = states
        self._variables = {one.name: one for one in graph.variables}
        numbers: dict[str, int] = {}
        for net in places.nets:
            if not net.constant:
                numbers.setdefault(net.variable, len(numbers) % _COLOURS)
        self._colours = {name: f"var(--w{at})" for name, at in numbers.items()}
        self._faults: dict[str, list[GraphFault]] = defaultdict(list)
        for fault in graph.faults:
            for task in fault.tasks:
                self._faults[task].append(fault)

    def text(self) -> str:
        """Return the whole drawing."""
        top = _EDGE + 2 * ROW
        below = top + self._places.height + ROW
        notes = list(self._notes(below))
        height = below + (len(notes) + 1) * (_TEXT + 3)
        longest = max((len(note) - note.index(">") for note in notes), default=0)
        width = max(self._places.width, min(longest, _LINE) * CHAR, 340) + 2 * _EDGE
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" class="pbonet" role="img" '
            f'width="{width:g}" height="{height:g}" '
            f'viewBox="0 0 {width:g} {height:g}">',
            f"<title>{_xml(_head(self._graph))}</title><style>{_STYLE}</style>",
            '<rect width="100%" height="100%" style="fill:var(--paper)"/>',
            _label(_EDGE, _EDGE + ROW, _head(self._graph), "title"),
            f'<g transform="translate({_EDGE:g} {top:g})">',
            *(self._band(band) for band in self._places.bands),
            *(self._net(at, net) for at, net in enumerate(self._places.nets)),
            *(self._name(band) for band in self._places.bands),
            *(part for card in self._places.cards for part in self._card(card)),
            "</g>",
            *notes,
            "</svg>\n",
        ]
        return "\n".join(parts)

    def _band(self, band: Band) -> str:
        return (
            f'<rect class="band" x="0" y="{band.y:g}" width="{self._places.width:g}" '
            f'height="{band.height:g}" rx="8"/>'
        )

    def _name(self, band: Band) -> str:
        rtpu = next((r for r in self._graph.rtpus if r.name == band.rtpu), None)
        about = band.rtpu
        if rtpu is not None:
            about += f" · {rtpu.scheduler}" + " · keeps the table" * rtpu.keeper
        return _label(10, band.y + 1.2 * ROW, about, "soft over")

    def _net(self, at: int, net: Net) -> str:
        """Return the wires of a net, over a border that shows where others cross."""
        routes = [one for one in self._places.routes if one.net == at]
        ways = [_way(one.points) for one in routes]
        colour = self._colours.get(net.variable, "var(--con)")
        style = "wire constant" if net.constant else "wire"
        stroke = "" if net.constant else f' style="stroke:{colour}"'
        writer = self._places.cards[net.writer].task.name
        readers = {self._places.cards[reader].task.name for reader, _ in net.readers}
        about = f"{net.variable}: {writer} → {', '.join(sorted(readers))}"
        return (
            f"<g><title>{_xml(about)}</title>"
            + "".join(f'<path class="halo" d="{way}"/>' for way in ways)
            + "".join(f'<path class="{style}"{stroke} d="{way}"/>' for way in ways)
            + "</g>"
        )

    # -- cards ------------------------------------------------------------------------

    def _card(self, card: Card) -> Iterator[str]:
        task, faults = card.task, self._faults[card.task.name]
        look = "card"
        if faults:
            look += " faulty" if "bad" in map(_severity, faults) else " doubtful"
        elif task.critical:
            look += " critical"
        look += " spare" * bool(task.fallback_of)
        about = "\n".join([task.desc, *(fault.text for fault in faults)]).strip()
        yield (
            f'<g transform="translate({card.x:g} {card.y:g})">'
            f"<title>{_xml(about)}</title>"
            f'<rect class="{look}" width="{card.width:g}" height="{card.height:g}" '
            f'rx="6"/>'
        )
        sign = " !" * bool(faults)
        yield _label(9, 1.15 * ROW, task.name, "name")
        rate = f"{task.freq:g} Hz" if task.freq else task.type
        yield _label(card.width - 9, 1.15 * ROW, f"{rate}{sign}", "soft end")
        yield _label(9, 2.05 * ROW, kind(task), "soft")
        if state := self._states.get(task.name):
            look = f"{state} end" if state in _SIGNS else "end"
            yield _label(card.width - 9, 2.05 * ROW, state_text(state), look)
        for at, port in enumerate(card.ins):
            yield self._port(card, at, port, is_input=True)
        for at, port in enumerate(card.outs):
            yield self._port(card, at, port, is_input=False)
        rows = max(len(card.ins), len(card.outs))
        for at, note in enumerate(card.notes):
            yield _label(9, card.offset(rows + at) + 4, note, "soft")
        yield "</g>"

    def _port(self, card: Card, at: int, port: GraphPort, *, is_input: bool) -> str:
        variable = self._variables[port.variable]
        y = card.offset(at)
        x = 0.0 if is_input else card.width
        side = variable.writers if is_input else variable.readers
        colour = self._colours.get(port.variable, "var(--con)")
        look = f'style="fill:{colour};stroke:{colour}"'
        if not side:
            look = f'class="open" style="stroke:{colour}"'
        mark = (
            f'<path d="M{x - 6:g} {y - 4:g}L{x:g} {y:g}L{x - 6:g} {y + 4:g}Z" {look}/>'
            if is_input
            else f'<circle cx="{x:g}" cy="{y:g}" r="2.6" {look}/>'
        )
        odd = self._odd(card, port)
        style = (odd or "soft" * port.constant) + " end" * (not is_input)
        place = 9 if is_input else card.width - 9
        return (
            f"<g><title>{_xml(_port_text(port, variable))}</title>{mark}"
            + _label(place, y + 4, port.variable + " !" * bool(odd), style)
            + "</g>"
        )

    def _odd(self, card: Card, port: GraphPort) -> str:
        """Return the look of the worst fault that names a port, or its variable."""
        found = {
            _severity(fault)
            for fault in self._faults[card.task.name]
            if port.variable in fault.variables or port.port in fault.ports
        }
        return min(found, default="")  # bad is before warn

    # -- below ------------------------------------------------------------------------

    def _notes(self, y: float) -> Iterator[str]:
        """Yield the legend, and below it the faults."""
        legend = "— variable   ··· constant   - - stands by   ! fault"
        if not self._graph.tasks:
            legend = "there are no tasks"
        texts = [(legend, "soft")]
        for fault in self._graph.faults:
            look = _severity(fault)
            word = {"bad": "fault", "warn": "warning"}[look]
            texts += [(line, look) for line in _wrapped(f"! {word}: {fault.text}")]
        for at, (text, look) in enumerate(texts):
            yield _label(_EDGE, y + at * (_TEXT + 3), text, look)


def _severity(fault: GraphFault) -> str:
    """Return the class of a fault's texts in the style sheet."""
    return "bad" if fault.severity == "refuse" else "warn"


def _head(graph: Graph) -> str:
    job = f", job {graph.job}" if graph.job else ""
    return f"subsystem {graph.name}{job}"


def _port_text(port: GraphPort, variable: GraphVariable) -> str:
    shape = f"[{', '.join(map(str, port.shape))}]" if port.shape else ""
    named = f" (port {port.port})" if port.port != port.variable else ""
    lines = [f"{port.variable}{named}: {port.type.removesuffix('[]')}{shape}"]
    lines[0] += f", {port.unit}" if port.unit not in {"", "none"} else ""
    lines.append(variable.desc if variable.type else "not in the .svar file")
    return "\n".join(line for line in lines if line)


def _label(x: float, y: float, text: str, look: str) -> str:
    """Return a line of text; spaces count."""
    style = f' class="{look.strip()}"' if look.strip() else ""
    return f'<text x="{x:g}" y="{y:g}"{style} xml:space="preserve">{_xml(text)}</text>'


def _wrapped(text: str) -> list[str]:
    return [
        one
        for line in text.splitlines()
        for one in textwrap.wrap(line, _LINE, subsequent_indent="  ") or [""]
    ]


def _xml(text: str) -> str:
    """Return a text escaped, without control characters that XML has no place for."""
    kept = (one if one.isprintable() or one == "\n" else "\ufffd" for one in text)
    return escaped("".join(kept))


def _way(points: Sequence[Point]) -> str:
    """Return the path through points, with round corners."""
    kept = list(_turns(points))
    parts = [f"M{kept[0][0]:g} {kept[0][1]:g}"]
    for before, at, after in zip(kept, kept[1:], kept[2:], strict=False):
        first, last = _toward(at, before), _toward(at, after)
        parts.append(
            f"L{first[0]:g} {first[1]:g}Q{at[0]:g} {at[1]:g} {last[0]:g} {last[1]:g}"
        )
    parts.append(f"L{kept[-1][0]:g} {kept[-1][1]:g}")
    return "".join(parts)


def _turns(points: Iterable[Point]) -> Iterator[Point]:
    """Yield the points without those that are there twice."""
    last: Point | None = None
    for point in points:
        if point != last:
            yield point
        last = point


def _toward(at: Point, other: Point) -> Point:
    """Return the point from which a corner is rounded."""
    dx, dy = other[0] - at[0], other[1] - at[1]
    length = abs(dx) + abs(dy)  # one of them is 0
    step = min(_ROUND, length / 2)
    return at[0] + dx / length * step, at[1] + dy / length * step
