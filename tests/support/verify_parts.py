"""Tasks and configurations for the tests of `legality`, in a few words."""

from collections.abc import Collection, Mapping

from msgspec import structs

from pbonet.analysis import legality
from pbonet.analysis.schedule.effective_time import from_steps
from pbonet.config.model import Rmod, RtpuEntry, Scheduler, SvarFile, TaskType, Variable
from pbonet.pbo import ModuleInfo
from pbonet.ports import Kind, Port, parse_shape

MS = 1_000_000
PROFILE = from_steps([(2 * MS, 0.5), (6 * MS, 0.9), (10 * MS, 1.0)])
"""A soft task's execution times: seconds in nanoseconds, and their shares."""
LISTS = {
    "inconst": Kind.INCONST,
    "outconst": Kind.OUTCONST,
    "invar": Kind.INVAR,
    "outvar": Kind.OUTVAR,
}


METHODS = ("cycle", "sync", "timing_failure")


def module(
    *ports: Port, critical_ok: bool = True, methods: tuple[str, ...] = METHODS
) -> ModuleInfo:
    return ModuleInfo(
        name="mod",
        cls="Mod",
        doc="",
        version="",
        file="",
        ports=ports,
        params=(),
        methods=methods,
        critical_ok=critical_ok,
    )


def port(kind: str, name: str, shape: str = "1", unit: str = "none", **more) -> Port:
    kind_of_value = "float" if shape == "1" else "float64[]"
    more = {"attr": name.lower(), "type": kind_of_value, **more}
    return Port(
        name=name, kind=LISTS[kind], shape=parse_shape(shape), unit=unit, doc="", **more
    )


def task(
    name: str,
    *,
    alias: Mapping[str, str] | None = None,
    info: ModuleInfo | bool | None = True,
    rtpu: str = "arm0",
    freq: float | None = 100.0,
    tasktype: TaskType = TaskType.PERIODIC,
    **rest,
) -> legality.Task:
    """Return a task; `invar` and so on are texts; its class has just these ports."""
    lists = {key: tuple(str(rest.pop(key, "")).split()) for key in LISTS}
    if info is True:
        info = module(*(port(key, p) for key, ports in lists.items() for p in ports))
    rmod = Rmod(
        name=name,
        file=f"{name}.rmod",
        module="mod",
        aliases=dict(alias or {}),
        freq=freq,
        tasktype=tasktype,
        **lists,
        **rest,
    )
    return legality.Task(rmod=rmod, info=info or None, rtpu=rtpu)


def configuration(
    *tasks: legality.Task,
    on: Collection[str] | None = None,
    variables: Collection[Variable] = (),
    init: Mapping[str, tuple[float, ...]] | None = None,
    rtpus: Collection[RtpuEntry] = (),
    **rest,
) -> legality.Configuration:
    """Return a configuration whose table has every variable that a task uses."""
    given = {variable.name: variable for variable in variables}
    names = [
        name
        for one in tasks
        for name in (*one.inputs, *one.outputs, *one.needs, *one.gives)
    ]
    table = {
        name: Variable(name=name, type="double", init=(init or {}).get(name))
        for name in names
    } | given
    svar = SvarFile(file="a.svar", defines={}, variables=tuple(table.values()))
    if on is None:
        on = {one.name for one in tasks}
    return legality.Configuration(
        svar=svar, tasks=tuple(tasks), on=frozenset(on), rtpus=tuple(rtpus), **rest
    )


def rtpu(name: str = "arm0", scheduler: str = "MUF", **rest) -> RtpuEntry:
    return RtpuEntry(name=name, scheduler=Scheduler(scheduler), **rest)


def texts(config: legality.Configuration) -> list[str]:
    return [legality.as_text(problem) for problem in legality.check(config)]


def figure_6_1(scheduler: str, **fourth) -> legality.Configuration:
    """The four tasks of Figure 6.1: 33, 40, 25 and 27 percent."""
    rows = [("t1", 6, 2), ("t2", 10, 4), ("t3", 12, 3), ("t4", 15, 4)]
    tasks = [
        task(
            name,
            freq=1000 / period,
            maxc=cost / 1000,
            **(fourth if name == "t4" else {}),
        )
        for name, period, cost in rows
    ]
    return configuration(*tasks, rtpus=[rtpu(scheduler=scheduler, maxfreq=1000.0)])


def with_server() -> legality.Configuration:
    soft = structs.replace(task("soft", freq=1000 / 12, softness=0.1), profile=PROFILE)
    server = task("srv", freq=100, capacity=0.002, tasktype=TaskType.DEFERRABLE)
    idle = task("idle", freq=None, tasktype=TaskType.BACKGROUND)
    return configuration(
        soft, task("a", freq=100, maxc=0.001, minc=0.0005), server, idle, rtpus=[rtpu()]
    )
