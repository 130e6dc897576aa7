"""What each command does: from its arguments to plain data, through `Subsystem`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from pbonet.analysis import legality
from pbonet.errors import ConfigError, SeveralError, StateError, VerificationError
from pbonet.master.subsystem import status_fields

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.master.subsystem import Transition

    from .session_state import Seat

Given: TypeAlias = dict[str, Any]
Data: TypeAlias = dict[str, Any]
_LAST_EVENTS = 20


def signal(name: str) -> Callable[[Seat, Given], Data]:
    """Return the action that sends `name` to tasks: one alone, or several as a list."""

    def send(seat: Seat, given: Given) -> Data:
        tasks = seat.tasks(given.get("task") or [])
        call: Callable[..., dict[str, str]] = getattr(seat.subsystem, name)
        return {"states": call(tasks, text=given.get("text") or "")}

    return send


def spawn(seat: Seat, given: Given) -> Data:
    """Create a task."""
    status = seat.subsystem.spawn(given["rmod"], given.get("rtpu"), given.get("hz"))
    seat.point_at(status.task)
    return {
        "states": {status.task: status.state},
        "rtpu": status.rtpu,
        "module": status.module,
        "version": status.version,
        "freq": status.ref_f,
    }


def reconfig(seat: Seat, given: Given) -> Data:
    """Send a list of signals."""
    items: list[tuple[str, str]] = given["item"]
    states = seat.subsystem.reconfig(items)
    seat.point_at(items[-1][0])
    return {"states": states}


def swap(seat: Seat, given: Given) -> Data:
    """Put tasks into the place of others."""
    old, new = (
        [name for name in given[arg].split(",") if name] for arg in ("old", "new")
    )
    found = seat.subsystem.swap(
        old, new, rtpu=given.get("rtpu"), dry_run=given.get("dry_run", False)
    )
    seat.point_at(new[-1])
    return _transition(found)


def switch(seat: Seat, given: Given) -> Data:
    """Go over to another job."""
    return _transition(
        seat.subsystem.switch(
            given.get("job"),
            dry_run=given.get("dry_run", False),
            wait=given.get("wait"),
        )
    )


def _transition(found: Transition) -> Data:
    data: Data = msgspec.to_builtins(found)
    return data


def start(seat: Seat, given: Given) -> Data:
    """Assemble a job."""
    statuses = seat.subsystem.start(given.get("job"), wait=given.get("wait"))
    return {"states": {status.task: status.state for status in statuses}}


def stop(seat: Seat, _: Given) -> Data:
    """Stop everything."""
    stopped = seat.subsystem.stop()
    return {"off": stopped.off, "killed": stopped.killed}


def check(seat: Seat, given: Given) -> Data:
    """Judge a job or what stands; an illegal one is an answer here, not a failure."""
    job: str | None = given.get("job")
    found: Data = {"legal": True, "warnings": [], "rtpus": []}
    try:
        found["rtpus"] = legality.report_data(seat.subsystem.report(job))
        found["warnings"] = seat.subsystem.check(job)
    except (ConfigError, VerificationError, SeveralError) as error:
        found |= {"legal": False, "error": error.to_wire()}
    return found


def freq(seat: Seat, given: Given) -> Data:
    """Show or set a frequency."""
    task = seat.task(given.get("task"))
    return {"task": task, "hz": seat.subsystem.freq(task, given.get("hz"))}


def get(seat: Seat, given: Given) -> Data:
    """Show parameters."""
    task = seat.task(given.get("task"), given.get("param"))
    params = seat.subsystem.get(task, given.get("param"))
    return {"task": task, "params": msgspec.to_builtins(params)}


def set_(seat: Seat, given: Given) -> Data:
    """Show or change parameters."""
    value: list[str] = given.get("value") or []
    if not value:
        return get(seat, given)
    task = seat.task(given.get("task"), given.get("param"))
    params = seat.subsystem.set(task, given["param"], " ".join(value))
    return {"task": task, "params": msgspec.to_builtins(params)}


def status(seat: Seat, given: Given) -> Data:
    """Show status since the last one that this interface showed."""
    wanted: list[str] = given.get("task") or []
    fields = (
        status_fields.columns([given["fields"]]) if given.get("fields") else seat.shown
    )
    rtpus = seat.subsystem.rtpu_status()
    for task in wanted:
        seat.subsystem.picture.find(task)
    if len(wanted) == 1:
        seat.point_at(wanted[0])
    tasks = [
        task
        for rtpu in rtpus
        for task in rtpu.tasks
        if not wanted or task.task in wanted
    ]
    profiles = seat.baselines.since(tasks)
    return {
        "fields": list(fields),
        "tasks": [msgspec.to_builtins(one) for one in profiles],
        "rtpus": [
            {
                "rtpu": rtpu.rtpu,
                "backend": rtpu.backend,
                "scheduler": rtpu.scheduler,
                "util": rtpu.util,
                "dispatcher": rtpu.dispatcher,
                "illegal": rtpu.illegal,
                "tbufs": [msgspec.to_builtins(link) for link in rtpu.tbufs],
                "stalls": rtpu.stalls,
                "stalled": rtpu.stalled,
            }
            for rtpu in rtpus
        ],
    }


def profiles(seat: Seat, given: Given) -> Data:
    """Show the profiles of tasks and of their RTPUs."""
    from pbonet.master.subsystem import profiling

    wanted: list[str] = given.get("task") or []
    found = seat.subsystem.profile(wanted)
    if len(wanted) == 1:
        seat.point_at(wanted[0])
    picture = seat.subsystem.picture
    tasks: list[Data] = []
    for one in found:
        member = picture.get(one.status.task)
        tasks.append(profiling.task_data(one, member.rmod if member else None))
    rtpus = [
        profiling.rtpu_data(status, tasks) for status in seat.subsystem.rtpu_status()
    ]
    return {"tasks": tasks, "rtpus": [one for one in rtpus if one["tasks"]]}


def profiles_save(seat: Seat, given: Given) -> Data:
    """Save the profiles of tasks."""
    saved = seat.subsystem.profile_save(given.get("task") or [])
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


def status_set(seat: Seat, given: Given) -> Data:
    """Choose the columns of status."""
    words: list[str] = given.get("field") or []
    if words:
        seat.shown = status_fields.columns(words)
    known = [
        {"name": field.name, "unit": field.unit, "doc": field.doc}
        for field in status_fields.FIELDS
    ]
    return {"shown": list(seat.shown), "known": known}


def display(seat: Seat, given: Given) -> Data:
    """Show variables."""
    values = seat.subsystem.display(
        given.get("variable"), task=given.get("task"), writer=given.get("writer")
    )
    return {"variables": [msgspec.to_builtins(value) for value in values]}


def write(seat: Seat, given: Given) -> Data:
    """Set a variable."""
    value = seat.subsystem.write(given["variable"], given["value"])
    return {"variables": [msgspec.to_builtins(value)]}


def module(seat: Seat, given: Given) -> Data:
    """List modules and RMODs, or show one module."""
    name: str | None = given.get("module")
    infos = seat.subsystem.module(name)
    if name is not None:
        return {"module": msgspec.to_builtins(infos[0])}
    return {
        "modules": [
            {"name": info.name, "version": info.version, "doc": info.doc}
            for info in infos
        ],
        "rmods": seat.subsystem.files.rmods(),
    }


def _number(word: int | str) -> int | str:
    return int(word) if str(word).isdecimal() else word


def events(seat: Seat, given: Given) -> Data:
    """Show what happened."""
    found = seat.subsystem.events(
        given.get("last", _LAST_EVENTS),
        since=_number(given.get("since", 0)),
        task=given.get("task"),
        code=given.get("code"),
        severity=given.get("severity"),
    )
    return {"events": [msgspec.to_builtins(event) for event in found]}


def events_count(seat: Seat, given: Given) -> Data:
    """Show how often each kind of event came."""
    return {"counts": seat.subsystem.events_count(given.get("task") or [])}


def help_(seat: Seat, given: Given) -> Data:
    """Show the commands."""
    return {
        "commands": [
            {
                "name": command.name,
                "usage": command.usage,
                "help": command.help,
                "changes": command.changes,
                "examples": [list(example) for example in command.examples],
                "args": [
                    {
                        "name": arg.name,
                        "kind": str(arg.kind),
                        "doc": arg.doc,
                        "use": str(arg.use),
                        "last": arg.last,
                    }
                    for arg in command.args
                ],
            }
            for command in seat.subsystem.help(given.get("command"))
        ]
    }


def wait(seat: Seat, given: Given) -> Data:
    """Wait; a stop ends it."""
    seat.subsystem.wait(given["seconds"])
    return {}


def sigwait(seat: Seat, given: Given) -> Data:
    """Wait for a signal of a task."""
    sent = seat.subsystem.sigwait(
        given.get("signal") or (),
        task=_split(given.get("task")),
        timeout=given.get("timeout"),
    )
    seat.point_at(sent.task)
    return {"sent": msgspec.to_builtins(sent)}


def sigmask(seat: Seat, given: Given) -> Data:
    """Show or set the masks of signals."""
    return {
        "masks": seat.subsystem.sigmask(given.get("signal") or None, given.get("task"))
    }


def _split(word: str | None) -> list[str]:
    return [name for name in (word or "").split(",") if name]


def network(seat: Seat, given: Given) -> Data:
    """Hand control to a program on the network."""
    portname: str = given["portname"]
    if seat.hand_over is None:
        raise StateError(
            "this interface cannot hand control over",
            remedy="give the command at the prompt or in a script",
        )
    seat.hand_over(portname)
    return {"portname": portname}


def quit_(seat: Seat, _: Given) -> Data:
    """End the interface."""
    seat.ended = True
    return {}
