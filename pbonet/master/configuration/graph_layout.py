"""The places of a graph's tasks and wires in a drawing.

Tasks are cards in columns, so that most wires go from one column to the next. Each RTPU
is a band across all columns. A wire goes straight or by one vertical piece in the gap
between two columns. One that passes a column runs above the cards of a band, and one
that goes back, which closes a control loop, below them; so no wire crosses a card.
"""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import pairwise
from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from .subsystem_graph import Graph, GraphPort, GraphTask

ROW = 16
"""Height of a port's row; the tops of cards are multiples of it."""
HEAD = 2.5 * ROW
"""Height of the head of a card, above its first port."""
FOOT = 0.5 * ROW
CHAR = 6.7
"""Width of a character of a port's name."""
TITLE = 2 * ROW
"""Height of a band's title."""
_GAP = ROW
"""Least space between two cards of a column."""
_LANE = 10
"""Distance of wires that run side by side."""
_MARGIN = 18
"""Space between a card and the first vertical piece."""
_SWEEPS = 8
_CONSTANT, _MEASURED, _HEAVY = 0.01, 0.4, 0.3
"""Weights of a constant, and of all that a robot measures for one task; below the last,
two tasks have only constants in common."""

Point = tuple[float, float]


class Card(Struct):
    """A task in the drawing."""

    task: GraphTask
    ins: list[GraphPort]
    outs: list[GraphPort]
    notes: list[str]
    """Lines below its ports: devices, links, parts."""
    band: int
    column: int = 0
    x: float = 0.0
    y: float = 0.0
    width: float = 0.0

    @property
    def height(self) -> float:
        """Its height."""
        rows = max(len(self.ins), len(self.outs)) + len(self.notes)
        return HEAD + rows * ROW + FOOT

    def offset(self, port: int) -> float:
        """Return how far below its top the middle of a port's row is."""
        return HEAD + (port + 0.5) * ROW


class Net(Struct):
    """A port that writes a variable, and the ports that read it."""

    variable: str
    constant: bool
    writer: int
    port: int
    readers: list[tuple[int, int]]
    """Card and port."""


class Route(Struct):
    """The way of a net to one of its readers."""

    net: int
    reader: int
    points: list[Point]


class Band(Struct):
    """An RTPU's part of the drawing."""

    rtpu: str
    y: float = 0.0
    height: float = 0.0


class Layout(Struct):
    """A drawing's places."""

    cards: list[Card]
    nets: list[Net]
    routes: list[Route]
    bands: list[Band]
    width: float
    height: float


class _Lane(Struct):
    """A horizontal piece above or below the cards of a band."""

    net: int
    band: int
    columns: tuple[int, int]
    """The first and the last gap that it touches."""
    above: bool
    at: int = 0
    y: float = 0.0


class _Piece(Struct):
    """The vertical piece of a net in a gap."""

    net: int
    left: list[float]
    """Where the net comes from the column before."""
    right: list[float]
    """Where it goes to the column after."""
    other: list[float]
    """Where it meets its lanes."""
    at: int = 0
    x: float = 0.0

    @property
    def ends(self) -> tuple[float, float]:
        """Its upper and its lower end."""
        found = [*self.left, *self.right, *self.other]
        return min(found), max(found)


def layout(graph: Graph, *, room: int = 0) -> Layout:
    """Return the places of all tasks and wires of a graph.

    Args:
        graph: What is drawn.
        room: Characters that stay free beside the second line of each card.
    """
    cards, bands = _cards(graph, room)
    nets = _nets(cards)
    _put_in_columns(cards, nets)
    columns = _ordered(cards, nets)
    _place_vertically(columns, cards, nets, len(bands))
    lanes = _lanes(cards, nets)
    height = _stack_bands(bands, cards, lanes)
    pieces = _pieces(cards, nets, lanes, len(columns))
    width = _place_horizontally(columns, cards, pieces)
    return Layout(
        cards=cards,
        nets=nets,
        routes=_routes(cards, nets, lanes, pieces),
        bands=bands,
        width=width,
        height=height,
    )


# -- cards and nets --------------------------------------------------------------------


def _cards(graph: Graph, room: int) -> tuple[list[Card], list[Band]]:
    names = [rtpu.name for rtpu in graph.rtpus]
    names += sorted({task.rtpu for task in graph.tasks} - {*names})
    used = [name for name in names if any(t.rtpu == name for t in graph.tasks)]
    cards = [
        Card(
            task=task,
            ins=sorted(task.ins, key=_constants_last),
            outs=sorted(task.outs, key=_constants_last),
            notes=_notes(graph, task),
            band=used.index(task.rtpu),
        )
        for task in graph.tasks
    ]
    for card in cards:
        card.width = _width(card, room)
    return cards, [Band(name) for name in used]


def _constants_last(port: GraphPort) -> bool:
    return port.constant


def _notes(graph: Graph, task: GraphTask) -> list[str]:
    notes = [f"runs {', '.join(task.parts)}"] if task.parts else []
    notes += [f"device {name}" for name in task.devices]
    for link in graph.links:
        if link.task == task.name:
            sign = "from" if link.direction == "in" else "as"
            notes.append(f"{link.variable} {sign} link {link.name}")
    return notes


def _width(card: Card, room: int) -> float:
    """Return the width that the texts of a card need."""
    ins = max((len(port.variable) for port in card.ins), default=0)
    outs = max((len(port.variable) for port in card.outs), default=0)
    head = len(card.task.name) * 1.2 + 13
    below = max((len(note) for note in card.notes), default=0)
    about = len(kind(card.task)) + 4 + room
    return max(ins + outs + 6, head, below + 2, about, 20) * CHAR


def kind(task: GraphTask) -> str:
    """Return what a task is, in words, for the second line of its card."""
    words = [
        task.class_ or task.type * (task.type != "periodic"),
        "CRITICAL" * task.critical,
        f"stands by for {task.fallback_of}" if task.fallback_of else "",
    ]
    return ", ".join(word for word in words if word) or task.module


def _nets(cards: Sequence[Card]) -> list[Net]:
    readers: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for at, card in enumerate(cards):
        for number, port in enumerate(card.ins):
            readers[port.variable].append((at, number))
    return [
        Net(port.variable, port.constant, at, number, readers[port.variable])
        for at, card in enumerate(cards)
        for number, port in enumerate(card.outs)
        if readers[port.variable]
    ]


# -- columns ---------------------------------------------------------------------------


def _put_in_columns(cards: Sequence[Card], nets: Sequence[Net]) -> None:
    """Give each card its column: after all that it reads, but for control loops."""
    weights = _weights(cards, nets)
    order = _flow(len(cards), weights)
    place = {card: at for at, card in enumerate(order)}
    forward = [
        (a, b) for (a, b), w in weights.items() if w > _HEAVY and place[a] < place[b]
    ]
    column = [0] * len(cards)
    for one in order:
        column[one] = max((column[a] + 1 for a, b in forward if b == one), default=0)
    for one in reversed(order):  # next to what reads it first
        after = [column[b] for a, b in forward if a == one]
        if after:
            column[one] = min(after) - 1
    for card, number in zip(cards, column, strict=True):
        card.column = number


def _weights(
    cards: Sequence[Card], nets: Sequence[Net]
) -> dict[tuple[int, int], float]:
    """Return for each two tasks how much it matters that one is before the other.

    What a robot measures goes back to where the loop begins, and constants have no
    direction that anybody looks for.
    """
    weights: dict[tuple[int, int], float] = defaultdict(float)
    for net in nets:
        robot = cards[net.writer].task.class_ == "robot interface"
        for pair in {(net.writer, reader) for reader, _ in net.readers}:
            if net.constant:
                weights[pair] += _CONSTANT
            elif pair[0] != pair[1]:
                weights[pair] = _MEASURED if robot else weights[pair] + 1.0
    return weights


def _flow(count: int, weights: dict[tuple[int, int], float]) -> list[int]:
    """Return an order in which wires of little weight go back.

    It begins with one in which nothing else goes back that need not, and moves each to
    the place where least goes back, until none is better elsewhere.
    """
    heavy = {pair: weight for pair, weight in weights.items() if weight >= 1.0}
    return _sifted(_sources_first(count, heavy), weights)


def _sources_first(count: int, weights: dict[tuple[int, int], float]) -> list[int]:
    """Return an order: what reads nothing first, in a circle what writes most."""
    left: list[int] = list(range(count))
    order: list[int] = []
    while left:
        ahead = dict.fromkeys(left, 0.0)
        behind = dict.fromkeys(left, 0.0)
        for (a, b), weight in weights.items():
            if a in ahead and b in ahead:
                ahead[a] += weight
                behind[b] += weight
        ready: list[int] = [one for one in left if not behind[one]]
        chosen: list[int] = ready or [
            max(left, key=lambda one: ahead[one] - behind[one])
        ]
        order += chosen
        left = [one for one in left if one not in chosen]
    return order


def _sifted(order: list[int], weights: dict[tuple[int, int], float]) -> list[int]:
    """Move each to its best place, until none is better elsewhere."""
    for _ in range(_SWEEPS):
        before = [*order]
        for one in before:
            _sift(order, one, weights)
        if order == before:
            break
    return order


def _sift(order: list[int], one: int, weights: dict[tuple[int, int], float]) -> None:
    """Move one to the place in an order where the least weight goes back."""
    old = order.index(one)
    del order[old]
    cost = best = 0.0
    place = 0
    costs = [0.0]
    for at, other in enumerate(order, 1):
        cost += weights.get((one, other), 0.0) - weights.get((other, one), 0.0)
        costs.append(cost)
        if cost < best:
            best, place = cost, at
    order.insert(old if costs[old] <= best else place, one)


def _ordered(cards: Sequence[Card], nets: Sequence[Net]) -> list[list[int]]:
    """Return the cards of each column from top to bottom, with few crossings."""
    count = max((card.column for card in cards), default=-1) + 1
    columns = [
        [at for at, card in enumerate(cards) if card.column == number]
        for number in range(count)
    ]
    for column in columns:
        column.sort(key=lambda at: cards[at].band)
    near = _neighbours(nets)
    for sweep in range(_SWEEPS):
        place = {at: n / len(c) for c in columns for n, at in enumerate(c)}
        for column in columns if sweep % 2 else reversed(columns):
            column.sort(key=_mean_of_neighbours(cards, near, place))
            place |= {at: n / len(column) for n, at in enumerate(column)}
    return columns


def _mean_of_neighbours(
    cards: Sequence[Card], near: dict[int, list[int]], place: dict[int, float]
) -> Callable[[int], tuple[int, float]]:
    def key(at: int) -> tuple[int, float]:
        found = [place[one] for one in near[at]] or [place[at]]
        return cards[at].band, sum(found) / len(found)

    return key


def _neighbours(nets: Iterable[Net]) -> dict[int, list[int]]:
    near: dict[int, list[int]] = defaultdict(list)
    for net in nets:
        if not net.constant:
            for reader, _ in net.readers:
                near[net.writer].append(reader)
                near[reader].append(net.writer)
    return near


# -- vertical places -------------------------------------------------------------------


def _place_vertically(
    columns: Sequence[list[int]],
    cards: Sequence[Card],
    nets: Sequence[Net],
    bands: int,
) -> None:
    """Give each card its top within its band, level with what it is connected to."""
    wishes = _wishes(cards, nets)
    for band in range(bands):
        stacks = [[at for at in c if cards[at].band == band] for c in columns]
        for stack in stacks:
            top = 0.0
            for at in stack:
                cards[at].y, top = top, top + cards[at].height + _GAP
        for sweep in range(_SWEEPS):
            for stack in stacks if sweep % 2 else reversed(stacks):
                _level(stack, cards, wishes)
        _compact(stacks, cards, wishes)


def _compact(
    stacks: Sequence[Sequence[int]],
    cards: Sequence[Card],
    wishes: dict[int, list[tuple[int, float]]],
) -> None:
    """Move cards up, together with those that they are level with."""
    above = {at: up for stack in stacks for up, at in pairwise(stack)}
    groups = _groups([at for stack in stacks for at in stack], wishes)
    for _ in range(len(groups) + 1):
        moved = False
        for group in groups:
            room = min(_room(at, above.get(at), cards, group) for at in group)
            for at in group:
                cards[at].y -= room
            moved = moved or room != 0.0
        if not moved:
            break


def _room(at: int, up: int | None, cards: Sequence[Card], group: set[int]) -> float:
    """Return how far a card can go up if its group goes with it."""
    if up is None:
        return cards[at].y
    if up in group:
        return cards[at].y  # as far as that one can
    return cards[at].y - (cards[up].y + cards[up].height + _GAP)


def _groups(
    members: Iterable[int], wishes: dict[int, list[tuple[int, float]]]
) -> list[set[int]]:
    """Return the sets of cards that are connected."""
    groups: list[set[int]] = []
    seen: set[int] = set()
    for one in members:
        group, new = set[int](), [one]
        while new:
            at = new.pop()
            if at not in seen:
                seen.add(at)
                group.add(at)
                new += [other for other, _ in wishes[at]]
        if group:
            groups.append(group)
    return groups


def _wishes(
    cards: Sequence[Card], nets: Sequence[Net]
) -> dict[int, list[tuple[int, float]]]:
    """Return for each card others of its band, and how far below them it is level."""
    found: dict[int, list[tuple[int, float]]] = defaultdict(list)
    for net in nets:
        writer = cards[net.writer]
        for reader, port in net.readers:
            other = cards[reader]
            if other.band == writer.band and other.column == writer.column + 1:
                shift = writer.offset(net.port) - other.offset(port)
                found[reader].append((net.writer, shift))
                found[net.writer].append((reader, -shift))
    return found


def _level(
    stack: Sequence[int],
    cards: Sequence[Card],
    wishes: dict[int, list[tuple[int, float]]],
) -> None:
    """Move the cards of a column near to where they are level, in their order."""
    blocks: list[tuple[float, int, list[int]]] = []  # sum of wishes, count, cards
    depth = 0.0
    below: dict[int, float] = {}
    for at in stack:
        below[at] = depth
        wanted = sorted(cards[one].y + shift for one, shift in wishes[at])
        wish = wanted[len(wanted) // 2] if wanted else cards[at].y
        block = (wish - depth, 1, [at])
        while blocks and blocks[-1][0] / blocks[-1][1] > block[0] / block[1]:
            total, count, first = blocks.pop()
            block = (total + block[0], count + block[1], first + block[2])
        blocks.append(block)
        depth += cards[at].height + _GAP
    for total, count, members in blocks:
        top = math.floor(total / count / ROW + 0.5) * ROW
        for at in members:
            cards[at].y = top + below[at]


# -- lanes -----------------------------------------------------------------------------


def _lanes(cards: Sequence[Card], nets: Sequence[Net]) -> list[_Lane]:
    """Return the horizontal pieces of nets that do not just go to the next column."""
    lanes: list[_Lane] = []
    for at, net in enumerate(nets):
        start = cards[net.writer].column
        far = [cards[r] for r, _ in net.readers if cards[r].column > start + 1]
        back = [cards[r] for r, _ in net.readers if cards[r].column <= start]
        own = cards[net.writer].band
        if far:
            band = max(own, *(card.band for card in far))
            last = max(card.column - 1 for card in far)
            lanes.append(_Lane(at, band, (start, last), above=True))
        if back:
            band = min(own, *(card.band for card in back))
            first = min(card.column - 1 for card in back)
            lanes.append(_Lane(at, band, (first, start), above=False))
    taken: dict[tuple[int, bool], list[list[_Lane]]] = defaultdict(list)

    def nested(lane: _Lane) -> tuple[int, float]:
        """Return a key: short ones are next to the cards, of equals the nearest."""
        writer = cards[nets[lane.net].writer]
        y = writer.y + writer.offset(nets[lane.net].port)
        return lane.columns[1] - lane.columns[0], y if lane.above else -y

    for lane in sorted(lanes, key=nested):
        rows = taken[lane.band, lane.above]
        fitting = [at for at, row in enumerate(rows) if _fits(lane, row)]
        lane.at = fitting[0] if fitting else len(rows)
        if not fitting:
            rows.append([])
        rows[lane.at].append(lane)
    return lanes


def _fits(lane: _Lane, row: Iterable[_Lane]) -> bool:
    """Return whether a lane touches none of a row."""
    first, last = lane.columns
    return all(last < one.columns[0] or one.columns[1] < first for one in row)


def _stack_bands(
    bands: Sequence[Band], cards: Sequence[Card], lanes: Sequence[_Lane]
) -> float:
    """Put the bands below each other; return the height of all."""
    top = 0.0
    for number, band in enumerate(bands):
        own = [lane for lane in lanes if lane.band == number]
        above = _rows(own, above=True)
        below = _rows(own, above=False)
        inside = [card for card in cards if card.band == number]
        first = top + TITLE + above * _LANE
        for card in inside:
            card.y += first
        last = max(card.y + card.height for card in inside)
        for lane in own:
            step = (lane.at + 1) * _LANE
            lane.y = first - step if lane.above else last + step
        band.y, band.height = top, last + (below + 1) * _LANE - top
        top += band.height + _GAP
    return top - _GAP if bands else 0.0


def _rows(lanes: Iterable[_Lane], *, above: bool) -> int:
    return max((lane.at + 1 for lane in lanes if lane.above is above), default=0)


# -- vertical pieces and horizontal places ---------------------------------------------


def _pieces(
    cards: Sequence[Card], nets: Sequence[Net], lanes: Sequence[_Lane], columns: int
) -> list[list[_Piece]]:
    """Return the vertical pieces in each gap; the first gap is before all columns."""
    of_net: dict[tuple[int, bool], _Lane] = {(one.net, one.above): one for one in lanes}
    gaps: list[dict[int, _Piece]] = [{} for _ in range(columns + 1)]
    for at, net in enumerate(nets):
        writer = cards[net.writer]
        begin = _Piece(at, [writer.y + writer.offset(net.port)], [], [])
        begin.other += [o.y for a in (True, False) if (o := of_net.get((at, a)))]
        gaps[writer.column + 1][at] = begin
        for reader, port in net.readers:
            card = cards[reader]
            piece = gaps[card.column].setdefault(at, _Piece(at, [], [], []))
            piece.right.append(card.y + card.offset(port))
            if card.column != writer.column + 1:
                piece.other.append(of_net[at, card.column > writer.column].y)
    found = [_in_order(list(gap.values())) for gap in gaps]
    for gap in found:
        _give_tracks(gap)
    return found


def _in_order(pieces: list[_Piece]) -> list[_Piece]:
    """Return the pieces of a gap from left to right, with few crossings."""
    pieces = sorted(pieces, key=lambda one: -min(one.ends))
    weights: dict[tuple[int, int], float] = {}
    for first, one in enumerate(pieces):
        for second, other in enumerate(pieces):
            if first != second and (cost := _crossings(other, one)):
                weights[first, second] = cost  # if `one` is not left of `other`
    return [pieces[at] for at in _sifted(list(range(len(pieces))), weights)]


def _crossings(one: _Piece, other: _Piece) -> float:
    """Return how badly two pieces cross if `one` is left of `other`."""
    return _hits(other.left, one.ends) + _hits(one.right, other.ends)


def _hits(ys: Iterable[float], ends: tuple[float, float]) -> float:
    first, last = ends
    touching = 100.0  # two wires would look like one
    return sum(touching if y in ends else 1.0 for y in ys if first <= y <= last)


def _give_tracks(pieces: Sequence[_Piece]) -> None:
    """Give pieces that overlap different tracks, in their order."""
    for at, piece in enumerate(pieces):
        first, last = piece.ends
        if first == last:
            continue  # straight: it has no vertical piece
        near = [
            one.at + 1
            for one in pieces[:at]
            if one.ends[0] <= last + 1
            and first <= one.ends[1] + 1
            and not _straight(one)
        ]
        piece.at = max(near, default=0)


def _straight(piece: _Piece) -> bool:
    first, last = piece.ends
    return first == last


def _place_horizontally(
    columns: Sequence[list[int]],
    cards: Sequence[Card],
    pieces: Sequence[Sequence[_Piece]],
) -> float:
    """Give columns and vertical pieces their places; return the width of all."""
    x = 0.0
    for number, gap in enumerate(pieces):
        tracks = max((piece.at + 1 for piece in gap if not _straight(piece)), default=0)
        for piece in gap:
            piece.x = x + _MARGIN + piece.at * _LANE
        x += 2 * _MARGIN + max(tracks - 1, 0) * _LANE
        if number < len(columns):
            width = max(cards[at].width for at in columns[number])
            for at in columns[number]:
                cards[at].x, cards[at].width = x, width
            x += width
    return x


def _routes(
    cards: Sequence[Card],
    nets: Sequence[Net],
    lanes: Sequence[_Lane],
    pieces: Sequence[Sequence[_Piece]],
) -> list[Route]:
    of_net = {(one.net, one.above): one.y for one in lanes}
    at_gap = {(gap, p.net): p.x for gap, found in enumerate(pieces) for p in found}
    routes: list[Route] = []
    for at, net in enumerate(nets):
        writer = cards[net.writer]
        begin = writer.y + writer.offset(net.port)
        x = at_gap[writer.column + 1, at]
        for reader, port in net.readers:
            card = cards[reader]
            end = card.y + card.offset(port)
            points = [(writer.x + writer.width, begin), (x, begin)]
            if card.column != writer.column + 1:
                lane = of_net[at, card.column > writer.column]
                last = at_gap[card.column, at]
                points += [(x, lane), (last, lane), (last, end)]
            else:
                points.append((x, end))
            points.append((card.x, end))
            routes.append(Route(at, reader, points))
    return routes
