"""The rows of the live table, from one reading of a subsystem."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.master.console import render
from pbonet.pbo import State
from pbonet.xm.net import AgentInfo, RtpuStatus, TaskStatus, VarValue

if TYPE_CHECKING:
    from pbonet.master.subsystem import Window, status_fields

Cell = str | int | float | None


class Reading(Struct, kw_only=True):
    """A reading of a subsystem at one time, each thing once."""

    rtpus: list[RtpuStatus] = []
    silent: dict[str, str] = {}
    """The error of each RTPU that does not answer."""
    agents: dict[str, AgentInfo] = {}
    """As last told, also of RTPUs that do not answer now."""
    values: list[VarValue] = []
    inputs: dict[str, list[str]] = {}
    """The variables that each task reads in its cycles."""
    complaints: list[str] = []


class Column(Struct, frozen=True):
    """A column: its head, and the field of `status` whose unit it has."""

    name: str
    field: str = ""


class Row(Struct, frozen=True):
    """A row, with what it is about."""

    kind: str
    """``task``, ``rtpu`` or ``variable``."""
    name: str
    cells: tuple[Cell, ...]
    mark: str = ""
    """``bad``: something is wrong; ``off``: it is OFF; else empty."""


COLUMNS: Final[dict[str, tuple[Column, ...]]] = {
    "tasks": (
        *(Column("task"), Column("rtpu"), Column("machine"), Column("state")),
        *(Column("Hz", "mezF"), Column("of", "refF"), Column("cycles")),
        *(Column("missed"), Column("failed"), Column("CPU", "avgU")),
        *(Column("CPU max", "maxC"), Column("jitter", "jitter")),
        *(Column("input age", "ptime"), Column("stale"), Column("flags")),
        Column("warn"),
    ),
    "RTPUs": (
        *(Column("rtpu"), Column("machine"), Column("state"), Column("core")),
        *(Column("backend"), Column("scheduler"), Column("tasks"), Column("on")),
        *(Column("load", "avgU"), Column("missed"), Column("stalls"), Column("flags")),
    ),
    "variables": (
        *(Column("variable"), Column("writer"), Column("age", "ptime")),
        *(Column("stale"), Column("unit")),
    ),
}
"""The views, and their columns."""


def rows(view: str, reading: Reading, window: Window) -> list[Row]:
    """Return the rows of a view.

    Args:
        view: One of `COLUMNS`.
        reading: What was read.
        window: Keeps statuses for rates; call this once for each reading.
    """
    if view == "tasks":
        return _tasks(reading, window)
    if view == "RTPUs":
        return _rtpus(reading, window)
    return [_variable(one) for one in reading.values]


def all_rows(reading: Reading, window: Window) -> dict[str, list[Row]]:
    """Return the rows of every view; call it once for each reading."""
    return {view: rows(view, reading, window) for view in COLUMNS}


def _machine(reading: Reading, rtpu: str) -> str:
    info = reading.agents.get(rtpu)
    return info.host if info is not None else "?"


def _raised(reading: Reading) -> dict[str, int]:
    """Return how many causes of the flag each task and RTPU has raised."""
    found: dict[str, int] = {}
    causes = {cause for rtpu in reading.rtpus for cause in rtpu.illegal}
    for cause in causes:
        raiser = cause.rpartition(" (")[2].removesuffix(")")
        for name in {raiser, raiser.partition("/")[0]}:
            found[name] = found.get(name, 0) + 1
    return found


def _tasks(reading: Reading, window: Window) -> list[Row]:
    raised = _raised(reading)
    values = {one.name: one for one in reading.values}
    found: list[Row] = []
    for rtpu in reading.rtpus:
        for task in rtpu.tasks:
            read = [values[n] for n in reading.inputs.get(task.task, ()) if n in values]
            flags = raised.get(f"{rtpu.rtpu}/{task.task}", 0)
            machine = _machine(reading, rtpu.rtpu)
            rates = window.rates(task)
            found.append(_task(task, rates, read, machine=machine, flags=flags))
    return found


def _task(
    task: TaskStatus,
    rates: dict[str, status_fields.Value],
    read: list[VarValue],
    *,
    machine: str,
    flags: int,
) -> Row:
    stale = sum(one.stale for one in read)
    ages = [one.age for one in read if one.age is not None]
    on = task.state == State.ON
    gone = task.state in {State.ERROR, State.NOT_CREATED}
    mark = "bad" if gone or stale or flags else "" if on else "off"
    cells = (
        task.task,
        task.rtpu,
        machine,
        task.state,
        rates["mezF"] if on else None,
        rates["refF"],
        task.cycle,
        task.miss,
        task.failed,
        rates["avgU"] if on else None,
        rates["maxC"],
        task.jitter_max,
        max(ages, default=None),
        stale,
        flags,
        task.warn,
    )
    return Row("task", task.task, cells, mark)


def _rtpus(reading: Reading, window: Window) -> list[Row]:
    raised = _raised(reading)
    found: list[Row] = []
    for rtpu in reading.rtpus:
        info = reading.agents.get(rtpu.rtpu)
        on = sum(task.state == State.ON for task in rtpu.tasks)
        cells = (
            rtpu.rtpu,
            _machine(reading, rtpu.rtpu),
            "answers",
            info.core if info is not None else None,
            rtpu.backend,
            rtpu.scheduler or "-",
            len(rtpu.tasks),
            on,
            100.0 * window.load(rtpu.tasks),
            sum(task.miss for task in rtpu.tasks),
            rtpu.stalls,
            raised.get(rtpu.rtpu, 0),
        )
        found.append(Row("rtpu", rtpu.rtpu, cells, "bad" if rtpu.illegal else ""))
    found += [
        Row("rtpu", name, _away(name, _machine(reading, name)), "bad")
        for name in reading.silent
    ]
    return found


def _away(name: str, machine: str) -> tuple[Cell, ...]:
    known: tuple[Cell, ...] = (name, machine, "away")
    return (*known, *([None] * (len(COLUMNS["RTPUs"]) - len(known))))


def _variable(one: VarValue) -> Row:
    cells = (one.name, one.writer or "-", one.age, int(one.stale), one.units)
    return Row("variable", one.name, cells, "bad" if one.stale else "")


def text_of(column: Column, cell: Cell) -> str:
    """Return a cell as text."""
    if cell is None:
        return "-"
    return render.cell(column.field, cell) if column.field else str(cell)
