"""A subsystem as a notebook shows it: a table of its tasks, and their graph.

Every text is escaped, and nothing is loaded.
"""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Final

from pbonet.master.configuration import graph_svg

from .status_fields import profile

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pbonet.errors import PbonetError
    from pbonet.master.configuration import Graph
    from pbonet.xm.net import TaskStatus

    from .status_fields import Value

_HEAD: Final = ("task", "RTPU", "state", "Hz", "of", "cycles", "missed", "CPU", "")
_PLANNED: Final = ("task", "RTPU", "Hz", "module", "")


def page(graph: Graph, statuses: Sequence[TaskStatus] | None) -> str:
    """Return a subsystem as HTML.

    Args:
        graph: Its graph.
        statuses: Of its tasks; None: it is not open.
    """
    return _planned(graph) if statuses is None else _open(graph, statuses)


def failed(name: str, error: PbonetError) -> str:
    """Return what is shown of a subsystem that cannot be read."""
    return f"<p><b>subsystem {escape(name)}</b></p><pre>{escape(str(error))}</pre>"


def _planned(graph: Graph) -> str:
    rows = [
        (
            task.name,
            task.rtpu,
            f"{task.freq:g}" if task.freq else task.type,
            task.module,
            task.desc,
        )
        for task in graph.tasks
    ]
    return _page(graph, "not open", _table(_PLANNED, rows), {})


def _open(graph: Graph, statuses: Sequence[TaskStatus]) -> str:
    states = {status.task: status.state for status in statuses}
    table = _table(_HEAD, map(_row, statuses))
    return _page(graph, f"open, {len(statuses)} tasks", table, states)


def _row(status: TaskStatus) -> tuple[str, ...]:
    found = profile(status)
    fields = found.fields
    notes = (found.error, found.warning, found.timing, found.standby, found.restarted)
    return (
        status.task,
        status.rtpu,
        graph_svg.state_text(status.state),
        *(_number(fields[name]) for name in ("mezF", "refF", "cycle", "miss")),
        f"{_number(fields['avgU'])} %",
        "; ".join(note for note in notes if note),
    )


def _number(value: Value) -> str:
    """Return a field as text, to four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value or 0)


def _page(graph: Graph, about: str, table: str, states: dict[str, str]) -> str:
    head = f"subsystem {graph.name}" + (f", job {graph.job}" if graph.job else "")
    drawing = graph_svg.svg(graph, states)
    return (
        f"<p><b>{escape(head)}</b> ({escape(about)})</p>{table}"
        f'<div style="overflow-x:auto">{drawing}</div>'
    )


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heads = "".join(f"<th>{escape(one)}</th>" for one in head)
    lines = "".join(
        "<tr>" + "".join(f"<td>{escape(one)}</td>" for one in row) + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table>"
