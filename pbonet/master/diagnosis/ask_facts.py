"""Reads from the agents of a subsystem what `explain` needs, each thing once.

All agents get a request at the same time, and each a fixed number of them, besides one
for the module of each task that is not known yet. What cannot be read is noted, and the
rest is judged.
"""

from __future__ import annotations

import time
from enum import Flag, auto
from typing import TYPE_CHECKING, Final

from pbonet.analysis import legality
from pbonet.errors import NodeError, PbonetError, SeveralError, SvarMissingError
from pbonet.master import configuration
from pbonet.master.subsystem import find_missing, start_refusals
from pbonet.xm.net import messages as m, rpc

from .facts import Facts

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pbonet.master.subsystem import Subsystem

    from .question import Question

PAUSE: Final = 0.3
"""Seconds between two readings of the status, which show whether cycles go on."""


class Extent(Flag):
    """Parts that only some questions need."""

    NONE = 0
    START = auto()
    """Whether the job would be refused."""
    SCHEDULE = auto()
    """The analysis of the RTPUs."""

    @staticmethod
    def of(asked: Question) -> Extent:
        """Return what a question needs."""
        parts = {"start": Extent.START, "miss": Extent.SCHEDULE}
        return parts.get(asked.kind, Extent.SCHEDULE)


def ask(
    subsystem: Subsystem,
    extent: Extent,
    job: str = "",
    *,
    traced: tuple[str, float] | None = None,
    pause: float = PAUSE,
) -> Facts:
    """Return the facts of an open subsystem.

    Args:
        subsystem: It is open, and may lack RTPUs.
        extent: What is needed.
        job: The job whose start is asked about; empty: the one it was opened with.
        traced: A task and seconds, for which its next miss is waited for, while the
            kernel says who has the core.
        pause: Seconds between the two readings of the status; in virtual time, which
            stands still meanwhile, there is one.
    """
    task_set, clients = subsystem.task_set, subsystem.clients
    unknown: list[str] = []

    def tried(what: str, read: Callable[[], None]) -> None:
        try:
            read()
        except PbonetError as error:
            unknown.append(f"{what}: {error}")

    trace: list[m.CoreTrace] = []
    if traced is not None:
        tried("who has the core", lambda: trace.append(_trace(subsystem, *traced)))
    begin = time.monotonic()
    try:
        statuses = {one.rtpu: one for one in task_set.refresh(strict=False)}
    except NodeError as error:  # none answers
        return unreached(subsystem, error)
    on_since = {} if subsystem.simulation is not None else _on_since(statuses)
    failed, there = task_set.silent, list(statuses)
    facts = Facts(
        subsystem=subsystem.name,
        graph=configuration.graph_of(subsystem.files, ()),
        rtpus=statuses,
        on_since=on_since,
        silent={name: error.to_wire() for name, error in failed.items()},
        keeper=subsystem.sbs.keeper,
        unknown=unknown,
        trace=trace[0] if trace else None,
    )

    def read_graph() -> None:
        facts.graph = subsystem.graph()

    tried("the tasks' modules", read_graph)
    _read_job(subsystem, facts, failed)
    facts.agents, _ = clients.each(lambda _: m.Hello(), m.AgentInfo, rtpus=there)
    facts.tables = m.mismatched(facts.agents.values())
    facts.held = m.held(facts.agents.values())
    events, _ = clients.each(lambda _: m.Events(), list[m.Event], rtpus=there)
    facts.events = _mine(subsystem.name, events)
    tried("the table", lambda: _read_table(subsystem, facts))
    if Extent.SCHEDULE in extent:
        tried("the schedule", lambda: _read_schedule(subsystem, facts))
    if Extent.START in extent:
        _read_start(subsystem, facts, job)
    if subsystem.simulation is None:
        time.sleep(max(pause - (time.monotonic() - begin), 0.0))
        facts.watched = time.monotonic() - begin
        again, _ = clients.each(lambda _: m.Status(), m.RtpuStatus, rtpus=there)
        facts.later = {
            task.task: task.cycle for rtpu in again.values() for task in rtpu.tasks
        }
    return facts


def _on_since(statuses: Mapping[str, m.RtpuStatus]) -> dict[str, float]:
    """Return when each task was turned on, from how long ago that is now.

    Args:
        statuses: They have just been read.
    """
    now = time.time()
    return {
        one.task: now - (one.now - one.on_ns) * 1e-9
        for rtpu in statuses.values()
        for one in rtpu.tasks
        if one.on_ns and one.now
    }


def _trace(subsystem: Subsystem, task: str, seconds: float) -> m.CoreTrace:
    """Have the agent of a task follow its core."""
    home = subsystem.task_set.locate(task)
    request = m.TraceCore(task=task, seconds=seconds)
    limit = seconds + rpc.ANSWER_TIME
    return subsystem.clients.call(home, request, m.CoreTrace, timeout=limit)


def unreached(subsystem: Subsystem, error: PbonetError) -> Facts:
    """Return the facts of a subsystem of which no RTPU answers.

    Args:
        subsystem: It could not be opened.
        error: Why not.
    """
    names = [one.name for one in subsystem.sbs.rtpus]
    errors = error.errors if isinstance(error, SeveralError) else (error,)
    by_place = {one.where: one for one in errors}
    failed = {name: by_place.get(name, errors[0]) for name in names}
    facts = Facts(
        subsystem=subsystem.name,
        graph=configuration.graph_of(subsystem.files, ()),
        silent={name: one.to_wire() for name, one in failed.items()},
        keeper=subsystem.sbs.keeper,
    )
    _read_job(subsystem, facts, failed)
    return facts


def _read_job(
    subsystem: Subsystem, facts: Facts, failed: Mapping[str, PbonetError]
) -> None:
    """Read what the job plans, from its files alone."""
    facts.missing = find_missing(subsystem.files, facts.rtpus.values(), failed)
    if subsystem.files.job is not None:
        try:
            facts.planned = configuration.job_graph(subsystem.files, code=False)
        except PbonetError as error:
            facts.unknown.append(f"the job: {error}")


def _mine(subsystem: str, events: dict[str, list[m.Event]]) -> list[m.Event]:
    found = [one for some in events.values() for one in some]
    mine = [one for one in found if one.subsystem in {"", subsystem}]
    return sorted(mine, key=lambda event: (event.wall, event.n))


def _read_table(subsystem: Subsystem, facts: Facts) -> None:
    """Read all variables, and how old each may be."""
    variables = {one.name: one for one in subsystem.files.table.variables}
    facts.limits = {
        name: one.maxage for name, one in variables.items() if one.maxage is not None
    }
    for member in subsystem.model:
        task = member.task
        ports = task.info.ports if task.info is not None else ()
        passed: list[str] = []
        for port in ports:
            name = task.rmod.svar_name(port.name)
            if name not in task.inputs:
                continue
            if (limit := legality.max_age(port, variables.get(name))) is not None:
                facts.limits[name] = min(limit, facts.limits.get(name, limit))
            if legality.passes(task, port):
                passed.append(name)
        if task.info is not None:
            facts.inherited[member.name] = passed
    if facts.keeper in facts.silent:
        return
    try:
        facts.values = {one.name: one for one in subsystem.display()}
    except SvarMissingError as error:
        facts.closed = error.what


def _read_schedule(subsystem: Subsystem, facts: Facts) -> None:
    facts.reports = subsystem.task_set.report()


def _read_start(subsystem: Subsystem, facts: Facts, job: str) -> None:
    """Read why a job would be refused: files, configuration, conditions, masters."""
    clients = subsystem.clients
    facts.masters = [one for one in clients.masters() if one != clients.client.name]
    rtpus = subsystem.sbs.rtpus
    facts.shared = [one.name for one in rtpus if one.usage == "shared"]
    facts.start = start_refusals(subsystem.task_set, job or None)
