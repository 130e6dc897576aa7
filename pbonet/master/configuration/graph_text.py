"""A graph as text: for a terminal, and as a Mermaid flowchart."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, NamedTuple

from .graph_layout import kind

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .subsystem_graph import Graph, GraphPort, GraphTask, GraphVariable

_NAME, _SIZE = 15, 12
"""Widths of columns: the longest name of a variable, and most sizes with units."""


def text(graph: Graph) -> str:
    """Return each task with what it reads, from whom, and what it writes, for whom."""
    job = f", job {graph.job}" if graph.job else ""
    counts = f"{len(graph.tasks)} tasks, {_used(graph)} variables"
    return "\n".join([f"subsystem {graph.name}{job}: {counts}", *_lines(graph)])


def _used(graph: Graph) -> int:
    return sum(bool(one.writers or one.readers) for one in graph.variables)


def _lines(graph: Graph) -> Iterator[str]:
    variables = {one.name: one for one in graph.variables}
    for rtpu in graph.rtpus:
        tasks = [task for task in graph.tasks if task.rtpu == rtpu.name]
        keeps = ", keeps the table" * rtpu.keeper
        yield f"\n{rtpu.name} ({rtpu.scheduler}{keeps})" + ": no tasks" * (not tasks)
        for task in tasks:
            yield from _task(graph, task, variables)
    for fault in graph.faults:
        word = "ERROR" if fault.severity == "refuse" else "WARNING"
        yield f"\n{word}> {fault.text}"


def _task(
    graph: Graph, task: GraphTask, variables: dict[str, GraphVariable]
) -> Iterator[str]:
    rate = f"{task.freq:g} Hz" if task.freq else task.type
    yield f"  {task.name}  {rate}, {kind(task)}"
    for port in task.ins:
        variable = variables[port.variable]
        yield _port("<-", port, variable, variable.writers)
    for port in task.outs:
        variable = variables[port.variable]
        yield _port("->", port, variable, variable.readers)
    yield from (f"      runs {' '.join(task.parts)}" for _ in task.parts[:1])
    yield from (f"      device {name}" for name in task.devices)
    for link in graph.links:
        if link.task == task.name:
            way = "<-" if link.direction == "in" else "->"
            yield f"    {way} {link.variable:{_NAME}} {'':{_SIZE}} link {link.name}"


def _port(
    sign: str, port: GraphPort, variable: GraphVariable, others: list[str]
) -> str:
    shape = f"[{', '.join(map(str, port.shape))}] " if port.shape else ""
    unit = variable.unit if variable.unit != "none" else ""
    size = f"{shape}{unit}".strip() if variable.type else "no variable"
    there = " ".join(others) or "no task"
    notes = " (constant)" * port.constant
    return f"    {sign} {port.variable:{_NAME}} {size:{_SIZE}} {there}{notes}".rstrip()


# -- Mermaid ---------------------------------------------------------------------------


class _Edge(NamedTuple):
    """All wires of one kind from one task to another."""

    writer: str
    reader: str
    constant: bool


def mermaid(graph: Graph) -> str:
    """Return the graph as a Mermaid flowchart: RTPUs as frames, constants dotted."""
    ids = {task.name: f"t{at}" for at, task in enumerate(graph.tasks)}
    lines = ["flowchart LR"]
    for at, rtpu in enumerate(_rtpus(graph)):
        lines.append(f'  subgraph r{at}["{_escaped(rtpu)}"]')
        lines += [
            f'    {ids[task.name]}["{_card(task)}"]'
            for task in graph.tasks
            if task.rtpu == rtpu
        ]
        lines.append("  end")
    edges: dict[_Edge, list[str]] = defaultdict(list)
    for wire in graph.wires:
        edges[_Edge(wire.from_, wire.to, wire.constant)].append(wire.variable)
    for edge, names in edges.items():
        arrow = "-.->" if edge.constant else "-->"
        label = _escaped(", ".join(names))
        lines.append(f'  {ids[edge.writer]} {arrow}|"{label}"| {ids[edge.reader]}')
    lines += _outside(graph, ids)
    lines += _marked(graph, ids)
    return "\n".join(lines)


def _rtpus(graph: Graph) -> list[str]:
    named = [*(rtpu.name for rtpu in graph.rtpus), *(t.rtpu for t in graph.tasks)]
    used = {task.rtpu for task in graph.tasks}
    return [name for name in dict.fromkeys(named) if name in used]


def _card(task: GraphTask) -> str:
    rate = f"{task.freq:g} Hz" if task.freq else task.type
    return "<br>".join(map(_escaped, (task.name, f"{rate}, {kind(task)}")))


def _outside(graph: Graph, ids: dict[str, str]) -> Iterator[str]:
    """Yield devices, and the ends of links that are elsewhere."""
    things = [(task.name, name) for task in graph.tasks for name in task.devices]
    for at, (task, name) in enumerate(things):
        yield f'  d{at}[/"device {_escaped(name)}"/] --- {ids[task]}'
    for at, link in enumerate(graph.links):
        end = f'x{at}(["link {_escaped(link.name)}"])'
        label = _escaped(link.variable)
        into = link.direction == "in"
        pair = (end, ids[link.task]) if into else (ids[link.task], end)
        yield f'  {pair[0]} -->|"{label}"| {pair[1]}'


def _marked(graph: Graph, ids: dict[str, str]) -> Iterator[str]:
    looks = {
        "refuse": "stroke:#c62828,stroke-width:3px",
        "warn": "stroke:#a15c00,stroke-width:3px",
    }
    told: set[str] = set()
    for severity, look in looks.items():
        faults = [one for one in graph.faults if one.severity == severity]
        tasks = {name for one in faults for name in one.tasks if name in ids} - told
        told |= tasks
        if tasks:
            yield f"  classDef {severity} {look}"
            yield f"  class {','.join(sorted(ids[t] for t in tasks))} {severity}"
    spare = [ids[task.name] for task in graph.tasks if task.fallback_of]
    if spare:
        yield "  classDef spare stroke-dasharray:6 4"
        yield f"  class {','.join(spare)} spare"


_CODES = {ord(sign): f"#{ord(sign)};" for sign in '"#&<>`|\\[]{}()'}
"""Signs that mean something to Mermaid, by the codes that it shows them for."""


def _escaped(words: str) -> str:
    shown = "".join(one if one.isprintable() else " " for one in words)
    return " ".join(shown.translate(_CODES).split())
