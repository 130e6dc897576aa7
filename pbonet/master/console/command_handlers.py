"""Commands that do more than pass their arguments on to a method of `Subsystem`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from pbonet.analysis import legality
from pbonet.errors import ConfigError, SeveralError, StateError, VerificationError
from pbonet.master.subsystem import find_missing, status_fields
from pbonet.versions import LAYERS
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from pbonet.xm.net import RtpuStatus

    from .session_state import SessionState

Given: TypeAlias = dict[str, Any]
Data: TypeAlias = dict[str, Any]
_LAST_EVENTS = 20


def spawn(session: SessionState, given: Given) -> Data:
    """Create a task."""
    status = session.subsystem.spawn(**given)
    session.default = status.task
    return {
        "states": {status.task: status.state},
        "rtpu": status.rtpu,
        "module": status.module,
        "version": status.version,
        "freq": status.ref_f,
    }


def start(session: SessionState, given: Given) -> Data:
    """Assemble a job."""
    statuses = session.subsystem.start(**given)
    return {"states": {status.task: status.state for status in statuses}}


def check(session: SessionState, given: Given) -> Data:
    """Verify a job or the present tasks; being illegal is a result, not an error."""
    job: str | None = given.get("job")
    found: Data = {"legal": True, "warnings": [], "rtpus": []}
    try:
        found["rtpus"] = legality.report_data(session.subsystem.report(job))
        found["warnings"] = session.subsystem.check(job)
    except (ConfigError, VerificationError, SeveralError) as error:
        found |= {"legal": False, "error": error.to_wire()}
    return found


def status(session: SessionState, given: Given) -> Data:
    """Show status since the last one that this interface showed."""
    wanted: list[str] = given.get("task") or []
    fields = _columns(given["fields"]) if given.get("fields") else session.shown
    rtpus = session.subsystem.rtpu_status()
    for task in wanted:
        session.subsystem.model.find(task)
    if len(wanted) == 1:
        session.default = wanted[0]
    tasks = [
        task
        for rtpu in rtpus
        for task in rtpu.tasks
        if not wanted or task.task in wanted
    ]
    if given.get("reset"):
        tasks = session.subsystem.task_set.restart_extremes(tasks)
    profiles = session.baselines.since(tasks)
    silent = session.subsystem.task_set.silent
    infos = _asked(session, rtpus)
    missing = [] if wanted else find_missing(session.subsystem.files, rtpus, silent)
    return {
        "fields": list(fields),
        "tasks": [msgspec.to_builtins(one) for one in profiles],
        "missing": [msgspec.to_builtins(one) for one in missing],
        "versions": m.mismatched(infos),
        "held": m.held(infos),
        "rtpus": [
            {
                "rtpu": rtpu.rtpu,
                "backend": rtpu.backend,
                "scheduler": rtpu.scheduler,
                "util": rtpu.util,
                "dispatcher": rtpu.dispatcher,
                "illegal": rtpu.illegal,
                "tbufs": [msgspec.to_builtins(link) for link in rtpu.tbufs],
                "spps": [msgspec.to_builtins(one) for one in rtpu.spps],
                "stalls": rtpu.stalls,
                "stalled": rtpu.stalled,
                "stall_age": rtpu.stall_age,
            }
            for rtpu in rtpus
        ],
    }


def _columns(text: str) -> tuple[str, ...]:
    """Return the columns of one status."""
    if text.rstrip().endswith(","):
        raise StateError(
            "the columns end with a comma",
            expected="one word, such as state,refF",
            got=text,
            remedy="leave out the space after each comma, or quote them all",
        )
    return status_fields.columns([text])


def _asked(session: SessionState, rtpus: list[RtpuStatus]) -> list[m.AgentInfo]:
    """Ask the agents for more if one does not answer, or has other versions."""
    subsystem = session.subsystem
    if subsystem.task_set.silent or any(one.versions != LAYERS for one in rtpus):
        return subsystem.clients.infos()
    return []


def profiles(session: SessionState, given: Given) -> Data:
    """Show the profiles of tasks and of their RTPUs."""
    from pbonet.master.subsystem import profiling

    wanted: list[str] = given.get("task") or []
    found = session.subsystem.profile(wanted)
    if len(wanted) == 1:
        session.default = wanted[0]
    model = session.subsystem.model
    tasks: list[Data] = []
    for one in found:
        member = model.get(one.status.task)
        tasks.append(profiling.task_data(one, member.rmod if member else None))
    rtpus = [
        profiling.rtpu_data(status, tasks) for status in session.subsystem.rtpu_status()
    ]
    return {"tasks": tasks, "rtpus": [one for one in rtpus if one["tasks"]]}


def profiles_save(session: SessionState, given: Given) -> Data:
    """Save the profiles of tasks."""
    saved = session.subsystem.profile_save(given.get("task") or [])
    return {
        "saved": [
            {
                "task": one.rmod,
                "file": str(path),
                "cycles": one.cycles,
                "least": one.least,
                "most": one.most,
            }
            for one, path in saved
        ]
    }


def status_set(session: SessionState, given: Given) -> Data:
    """Choose the columns of status."""
    words: list[str] = given.get("field") or []
    if words:
        session.shown = status_fields.columns(words)
    known = [
        {"name": field.name, "unit": field.unit, "doc": field.doc}
        for field in status_fields.FIELDS
    ]
    return {"shown": list(session.shown), "known": known}


def write(session: SessionState, given: Given) -> Data:
    """Set a variable."""
    value = session.subsystem.write(**given)
    return {"variables": [msgspec.to_builtins(value)]}


def library(session: SessionState, given: Given) -> Data:
    """Find modules; one is shown in full."""
    return {"modules": [one.data for one in session.subsystem.library(**given)]}


def events(session: SessionState, given: Given) -> Data:
    """Show what happened."""
    given.setdefault("last", _LAST_EVENTS)
    found = session.subsystem.events(**given)
    return {"events": [msgspec.to_builtins(event) for event in found]}


def explain(session: SessionState, given: Given) -> Data:
    """Explain why something is as it is."""
    from pbonet.master import diagnosis

    words, trace = given.get("what") or (), given.get("trace") or 0.0
    found = diagnosis.answer_of(session.subsystem, words, trace=trace)
    data: Data = msgspec.to_builtins(found)
    return data


def sigwait(session: SessionState, given: Given) -> Data:
    """Wait for a signal of a task."""
    sent = session.subsystem.sigwait(**given)
    session.default = sent.task
    return {"sent": msgspec.to_builtins(sent)}


def network(session: SessionState, given: Given) -> Data:
    """Hand control to a program on the network."""
    portname: str = given["portname"]
    if session.hand_over is None:
        raise StateError(
            "this interface cannot hand control over",
            remedy="give the command at the prompt or in a script",
        )
    session.hand_over(portname)
    return {"portname": portname}


def quit_(session: SessionState, _: Given) -> Data:
    """End the interface."""
    session.ended = True
    return {}
