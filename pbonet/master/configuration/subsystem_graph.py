"""The graph of a subsystem as data: its tasks, and the variables that connect them.

It is made from what a job plans or from the tasks of an open subsystem, and is what
``pbonet graph`` draws and what the page shows. `msgspec.to_builtins` makes dictionaries
and lists of it.
"""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, NamedTuple

from msgspec import Struct, field, structs

from pbonet.analysis import legality
from pbonet.errors import PbonetError
from pbonet.pbo import ANY_COUNT

from .check_files import judged, planned_tasks
from .saved_profiles import here

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pbonet.config import LocalLine, Rmod, Variable
    from pbonet.errors import WireError
    from pbonet.pbo import ModuleInfo, ParamInfo
    from pbonet.ports import Port

    from .check_files import Findings
    from .subsystem_files import Files

_LINKS = {"tbuf_send": "out", "tbuf_receive": "in"}
"""The modules that are an end of a link to another subsystem, and its direction."""
_LISTS = {"inconst": True, "invar": False}, {"outconst": True, "outvar": False}
"""The lists of an RMOD that name inputs and outputs, and whether of constants."""


class GraphRtpu(Struct, frozen=True):
    """An RTPU of the subsystem."""

    name: str
    scheduler: str
    keeper: bool
    """Whether it keeps the table."""


class GraphPort(Struct, frozen=True, kw_only=True):
    """A port of a task."""

    port: str
    """Its name in the module."""
    variable: str
    """Its name in the table."""
    constant: bool
    unit: str
    shape: list[int | str]
    """Sizes; a name where the table and the module do not tell the size."""
    type: str
    """As the module says, else as the table."""


class GraphParam(Struct, frozen=True, kw_only=True):
    """A parameter of a task, with its value in the RMOD or else its default."""

    name: str
    unit: str
    desc: str
    type: str
    """In words; empty where the module is not known."""
    bounds: str
    """In words."""
    shape: list[int]
    """Empty for one value, else how many."""
    low: float | None
    high: float | None
    value: list[float | bool | str] | None
    """None: it has none."""


class GraphTask(Struct, frozen=True, kw_only=True):
    """A task."""

    name: str
    module: str
    class_: str = field(name="class")
    """The class of its module, such as ``robot interface``; empty: not known."""
    desc: str
    rtpu: str
    freq: float
    """Hz; 0 where it has no rate of its own."""
    type: str
    """As TASKTYPE says."""
    crit: str
    """The criticality in its RMOD; empty: it is assigned."""
    critical: bool
    """Whether it is CRITICAL."""
    fallback_of: str
    """The task that it stands by for."""
    parts: list[str]
    """The RMODs that a combination runs as one task."""
    devices: list[str]
    ins: list[GraphPort]
    outs: list[GraphPort]
    params: list[GraphParam]
    rmod_file: str


class GraphVariable(Struct, frozen=True, kw_only=True):
    """A variable of the table, or one that ports name and the table lacks."""

    name: str
    desc: str
    unit: str
    type: str
    """Empty: the table has no such variable."""
    shape: list[int]
    n: int
    """The number of its elements."""
    constant: bool
    """Whether a port uses it as a constant."""
    writers: list[str]
    readers: list[str]


class Wire(Struct, frozen=True, rename={"from_": "from"}):
    """A connection of two tasks by a variable."""

    variable: str
    from_: str
    to: str
    constant: bool


class Link(Struct, frozen=True, kw_only=True, rename={"from_": "from"}):
    """A link to another subsystem."""

    name: str
    task: str
    variable: str
    direction: str
    """``in`` or ``out``."""
    from_: str = ""
    """Of one that comes in: the subsystem, or the RTPU, of its writer."""
    to: str = ""
    """Of one that goes out: empty: its writer does not know its reader."""


class GraphFault(Struct, frozen=True, kw_only=True):
    """Something that makes the subsystem illegal, or that is doubtful."""

    text: str
    """The whole message."""
    severity: str
    """``refuse`` or ``warn``."""
    tasks: list[str] = []
    variables: list[str] = []
    ports: list[str] = []
    remedy: str = ""


class Graph(Struct, frozen=True, kw_only=True):
    """The graph of a subsystem."""

    name: str
    """The subsystem's."""
    job: str
    """The job's; empty: none is named."""
    rtpus: list[GraphRtpu]
    tasks: list[GraphTask]
    variables: list[GraphVariable]
    wires: list[Wire]
    links: list[Link]
    faults: list[GraphFault]


def job_graph(files: Files, host: str = "", *, code: bool = True) -> Graph:
    """Return the graph of a job, or of a subsystem without tasks; no agent is needed.

    Args:
        files: Its files; without a job there are no tasks in the graph.
        host: The machine whose saved profiles are used; this one if empty.
        code: Import the modules: else units, sizes and types are those of the table.
    """
    if files.job is None:
        return graph_of(files, ())
    tasks, found = planned_tasks(files, host or here(), code=code)
    return planned_graph(files, tasks, found, judged(files, tasks))


def planned_graph(
    files: Files,
    tasks: Sequence[legality.Task],
    found: Findings,
    verdict: legality.Verdict | None,
) -> Graph:
    """Return the graph of a job that was judged.

    Args:
        files: Its files.
        tasks: Those of its tasks whose parts can be read; see `planned_tasks`.
        found: The faults of the others.
        verdict: The verdict on the job; None if `tasks` are not all.
    """
    lines = files.read_job().tasks
    names = [name for line in lines for name in (line.rmod, line.fallback)]
    whole = [*tasks, *_undescribed(files, tasks)]
    whole.sort(key=lambda task: names.index(task.rmod.name))
    faults = [_fault_of(error, whole) for error in found.errors]
    faults += [GraphFault(text=text, severity="warn") for text in found.warnings]
    return graph_of(files, whole, verdict.problems if verdict else (), faults)


def graph_of(
    files: Files,
    tasks: Sequence[legality.Task],
    problems: Iterable[legality.Problem] = (),
    faults: Sequence[GraphFault] = (),
) -> Graph:
    """Return the graph of tasks, planned or existing.

    Args:
        files: The subsystem's files.
        tasks: Its tasks; their ports are described if their modules are known.
        problems: What verification says of them.
        faults: Others that were found before.
    """
    table = {variable.name: variable for variable in files.table.variables}
    made = [_task(task, table) for task in tasks]
    keeper = files.sbs.keeper
    return Graph(
        name=files.sbs.subsystem,
        job=files.job.name if files.job else "",
        rtpus=[
            GraphRtpu(one.name, one.scheduler.value, one.name == keeper)
            for one in files.sbs.rtpus
        ],
        tasks=made,
        variables=_variables(table, made),
        wires=_wires(made),
        links=[link for task in tasks for link in _links(task)],
        faults=[*faults, *map(fault, problems)],
    )


def with_planned(files: Files, graph: Graph, planned: Graph) -> Graph:
    """Return the graph of existing tasks, and of those that a job plans beside them.

    Args:
        files: The subsystem's files.
        graph: That of the existing tasks.
        planned: That of the job, whose order of tasks is kept.
    """
    there = {one.name: one for one in graph.tasks}
    tasks = [there.pop(one.name, one) for one in planned.tasks]
    tasks += there.values()
    names = {one.name for one in graph.tasks}
    table = {variable.name: variable for variable in files.table.variables}
    return structs.replace(
        graph,
        job=planned.job,
        tasks=tasks,
        variables=_variables(table, tasks),
        wires=_wires(tasks),
        links=[*graph.links, *(one for one in planned.links if one.task not in names)],
    )


def unread(text: str, task: str) -> GraphFault:
    """Return the fault of a task whose module cannot be described."""
    severity = legality.Severity.REFUSE.value
    return GraphFault(text=text, severity=severity, tasks=[task])


def _undescribed(
    files: Files, tasks: Sequence[legality.Task]
) -> Iterable[legality.Task]:
    """Yield the tasks of the job that are missing, where their RMODs can be read."""
    there = {task.rmod.name for task in tasks}
    for line in files.read_job().tasks:
        for name, original in ((line.rmod, ""), (line.fallback, line.rmod)):
            if name is None or name in there:
                continue
            with contextlib.suppress(PbonetError):  # it is among the faults
                rmod = files.rmod(name, line.freq).record
                yield legality.Task(
                    rmod=rmod,
                    rtpu=line.rtpu or rmod.rtpu or files.sbs.rtpus[0].name,
                    freq=None if original else line.freq,
                    fallback_of=original,
                )


def _task(task: legality.Task, table: dict[str, Variable]) -> GraphTask:
    rmod, info = task.rmod, task.info
    things = legality.named_things(rmod, info)
    return GraphTask(
        name=task.name,
        module=rmod.module,
        class_=info.module_class if info else "",
        desc=rmod.desc or (info.doc if info else ""),
        rtpu=task.rtpu,
        freq=task.hz or 0.0,
        type=rmod.tasktype.value,
        crit="" if rmod.crit is None else str(rmod.crit),
        critical=rmod.critical,
        fallback_of=task.fallback_of,
        parts=[part.name for part in rmod.parts],
        devices=[one.name for one in things if one.kind == "device"],
        ins=_ports(task, _LISTS[0], table),
        outs=_ports(task, _LISTS[1], table),
        params=_params(rmod, info),
        rmod_file=rmod.file,
    )


def _ports(
    task: legality.Task, lists: dict[str, bool], table: dict[str, Variable]
) -> list[GraphPort]:
    ports = {port.name: port for port in task.info.ports} if task.info else {}
    found: list[GraphPort] = []
    for keyword, constant in lists.items():
        names: tuple[str, ...] = getattr(task.rmod, keyword)
        for name in names:
            variable = task.rmod.svar_name(name)
            found.append(
                _port(name, variable, ports.get(name), table.get(variable), constant)
            )
    return found


def _port(
    name: str,
    variable: str,
    port: Port | None,
    held: Variable | None,
    constant: bool,  # noqa: FBT001 - one of the port's properties
) -> GraphPort:
    count = held.nelem if held else 0
    if port is None:
        shape: list[int | str] = _plain_shape(count)
        unit, kind = (held.units, held.type) if held else ("", "")
    else:
        shape, unit, kind = _shape(port, count), port.unit, port.type
    return GraphPort(
        port=name,
        variable=variable,
        constant=constant,
        unit=unit,
        shape=shape,
        type=kind,
    )


def _plain_shape(count: int) -> list[int | str]:
    return [count] if count > 1 else []


def _shape(port: Port, count: int) -> list[int | str]:
    """Return the shape of a port; a single name in it stands for the size left."""
    shape = list(port.shape)
    named = [at for at, size in enumerate(shape) if isinstance(size, str)]
    known = math.prod(size for size in shape if isinstance(size, int))
    if len(named) == 1 and count and count % known == 0:
        shape[named[0]] = count // known
    return shape


def _params(rmod: Rmod, info: ModuleInfo | None) -> list[GraphParam]:
    given = {key.lower(): line for key, line in rmod.settings.items()}
    if info is None:
        return [_param_of_line(key, line) for key, line in given.items()]
    return [_param(one, given.get(one.name.lower())) for one in info.params]


def _param_of_line(name: str, line: LocalLine) -> GraphParam:
    """Return a parameter of which only the line in the RMOD is known."""
    count = len(line.words)
    return GraphParam(
        name=name,
        unit="",
        desc="",
        type="",
        bounds="",
        shape=[count] if count > 1 else [],
        low=None,
        high=None,
        value=[_number(word) for word in line.words],
    )


def _param(about: ParamInfo, line: LocalLine | None) -> GraphParam:
    value = _value(about, line)
    count = len(value or ()) if about.count == ANY_COUNT else about.count
    return GraphParam(
        name=about.name,
        unit=about.unit,
        desc=about.doc,
        type=about.type,
        bounds=about.bounds,
        shape=[count] if about.count else [],
        low=about.low,
        high=about.high,
        value=value,
    )


def _value(about: ParamInfo, line: LocalLine | None) -> list[float | bool | str] | None:
    """Return the words of the RMOD's line, or else of the default."""
    if line is None and about.required:
        return None
    words = about.default.split() if line is None else [*line.words]
    if about.type.endswith("str") or about.type.startswith("one of "):
        return [*words] if about.count else [" ".join(words)]
    return [_number(word) for word in words]


def _number(word: str) -> float | bool | str:
    """Return the number that a word is, or yes or no, or else the word."""
    low = word.lower()
    if low in {"yes", "true", "on", "no", "false", "off"}:
        return low in {"yes", "true", "on"}
    try:
        return int(word, 0)
    except ValueError:
        pass
    try:
        return float(word)
    except ValueError:
        return word


class _Use(NamedTuple):
    """The tasks that use a variable."""

    writers: list[str]
    readers: list[str]
    ports: list[GraphPort]


def _variables(
    table: dict[str, Variable], tasks: Sequence[GraphTask]
) -> list[GraphVariable]:
    uses = {name: _Use([], [], []) for name in table}
    for task in tasks:
        for port in (*task.ins, *task.outs):
            uses.setdefault(port.variable, _Use([], [], [])).ports.append(port)
        for port in task.ins:
            uses[port.variable].readers.append(task.name)
        for port in task.outs:
            uses[port.variable].writers.append(task.name)
    return [_variable(name, table.get(name), use) for name, use in uses.items()]


def _variable(name: str, held: Variable | None, use: _Use) -> GraphVariable:
    count = held.nelem if held else 0
    return GraphVariable(
        name=name,
        desc=held.desc if held else "",
        unit=held.units if held else use.ports[0].unit,
        type=held.type if held else "",
        shape=[count] if count > 1 else [],
        n=count,
        constant=any(port.constant for port in use.ports),
        writers=use.writers,
        readers=use.readers,
    )


def _wires(tasks: Sequence[GraphTask]) -> list[Wire]:
    """Return a wire from each writer of a variable to each of its readers."""
    readers: dict[str, list[tuple[str, bool]]] = {}
    for task in tasks:
        for port in task.ins:
            readers.setdefault(port.variable, []).append((task.name, port.constant))
    return [
        Wire(port.variable, task.name, reader, constant or port.constant)
        for task in tasks
        for port in task.outs
        for reader, constant in readers.get(port.variable, ())
    ]


def _links(task: legality.Task) -> Iterable[Link]:
    """Yield the links that a task, or a part of it, has an end of."""
    for rmod in task.rmod.parts or (task.rmod,):
        direction = _LINKS.get(rmod.module)
        line = {key.lower(): line for key, line in rmod.settings.items()}.get("link")
        if direction is None or line is None:
            continue
        name = " ".join(line.words)
        for port in (*rmod.invar, *rmod.outvar):
            variable = task.rmod.svar_name(rmod.svar_name(port))
            yield Link(
                name=name,
                task=task.name,
                variable=variable,
                direction=direction,
                from_=name.rpartition(":")[0] if direction == "in" else "",
            )


def fault(problem: legality.Problem) -> GraphFault:
    """Return the fault that a problem is."""
    return GraphFault(
        text=legality.as_text(problem),
        severity=problem.severity.value,
        tasks=[*problem.tasks],
        variables=[*problem.variables],
        ports=[*problem.ports],
        remedy=problem.remedy,
    )


def _fault_of(error: WireError, tasks: Iterable[legality.Task]) -> GraphFault:
    """Return the fault that an error is, with the tasks in whose RMODs it is."""
    where = f"{error.get('where', '')}:"
    return GraphFault(
        text=str(PbonetError.from_wire(error)),
        tasks=[task.name for task in tasks if where.startswith(f"{task.rmod.file}:")],
        severity=legality.Severity.REFUSE.value,
        remedy=error.get("remedy", ""),
    )
