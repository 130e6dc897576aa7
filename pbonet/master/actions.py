"""What each command does: from its arguments to plain data, through `Subsystem`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from pbonet import verify
from pbonet.errors import (
    ConfigError,
    PbonetError,
    SeveralError,
    StateError,
    UnknownTaskError,
    VerificationError,
    did_you_mean,
)
from pbonet.master import profile, profiling

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.master.desk import Desk
    from pbonet.master.switching import Transition

Given: TypeAlias = dict[str, Any]
Data: TypeAlias = dict[str, Any]
_LAST_EVENTS = 20


def signal(name: str) -> Callable[[Desk, Given], Data]:
    """Return the action that sends `name` to tasks: one alone, or several as a list."""

    def send(desk: Desk, given: Given) -> Data:
        tasks = desk.tasks(given.get("task") or [])
        call: Callable[..., dict[str, str]] = getattr(desk.subsystem, name)
        return {"states": call(tasks, text=given.get("text") or "")}

    return send


def spawn(desk: Desk, given: Given) -> Data:
    """Create a task."""
    status = desk.subsystem.spawn(given["rmod"], given.get("rtpu"), given.get("hz"))
    desk.point_at(status.task)
    return {
        "states": {status.task: status.state},
        "rtpu": status.rtpu,
        "module": status.module,
        "version": status.version,
        "freq": status.ref_f,
    }


def reconfig(desk: Desk, given: Given) -> Data:
    """Send a list of signals."""
    items: list[tuple[str, str]] = given["item"]
    states = desk.subsystem.reconfig(items)
    desk.point_at(items[-1][0])
    return {"states": states}


def swap(desk: Desk, given: Given) -> Data:
    """Put tasks into the place of others."""
    old, new = (
        [name for name in given[arg].split(",") if name] for arg in ("old", "new")
    )
    found = desk.subsystem.swap(
        old, new, rtpu=given.get("rtpu"), dry_run=given.get("dry_run", False)
    )
    desk.point_at(new[-1])
    return _transition(found)


def switch(desk: Desk, given: Given) -> Data:
    """Go over to another job."""
    return _transition(
        desk.subsystem.switch(
            given.get("job"),
            dry_run=given.get("dry_run", False),
            wait=given.get("wait"),
        )
    )


def _transition(found: Transition) -> Data:
    data: Data = msgspec.to_builtins(found)
    return data


def start(desk: Desk, given: Given) -> Data:
    """Assemble a job."""
    statuses = desk.subsystem.start(given.get("job"), wait=given.get("wait"))
    return {"states": {status.task: status.state for status in statuses}}


def stop(desk: Desk, _: Given) -> Data:
    """Stop everything."""
    stopped = desk.subsystem.stop()
    return {"off": stopped.off, "killed": stopped.killed}


def check(desk: Desk, given: Given) -> Data:
    """Judge a job or what stands; an illegal one is an answer here, not a failure."""
    job: str | None = given.get("job")
    found: Data = {"legal": True, "warnings": [], "rtpus": []}
    try:
        found["rtpus"] = verify.report_data(desk.subsystem.report(job))
        found["warnings"] = desk.subsystem.check(job)
    except (ConfigError, VerificationError, SeveralError) as error:
        found |= {"legal": False, "error": error.to_wire()}
    return found


def freq(desk: Desk, given: Given) -> Data:
    """Show or set a frequency."""
    task = desk.task(given.get("task"))
    return {"task": task, "hz": desk.subsystem.freq(task, given.get("hz"))}


def get(desk: Desk, given: Given) -> Data:
    """Show parameters."""
    task = desk.task(given.get("task"), given.get("param"))
    params = desk.subsystem.get(task, given.get("param"))
    return {"task": task, "params": msgspec.to_builtins(params)}


def set_(desk: Desk, given: Given) -> Data:
    """Show or change parameters."""
    value: list[str] = given.get("value") or []
    if not value:
        return get(desk, given)
    task = desk.task(given.get("task"), given.get("param"))
    params = desk.subsystem.set(task, given["param"], " ".join(value))
    return {"task": task, "params": msgspec.to_builtins(params)}


def status(desk: Desk, given: Given) -> Data:
    """Show status since the last one that this interface showed."""
    wanted: list[str] = given.get("task") or []
    fields = profile.columns([given["fields"]]) if given.get("fields") else desk.shown
    rtpus = desk.subsystem.rtpu_status()
    for task in wanted:
        desk.subsystem.picture.find(task)
    if len(wanted) == 1:
        desk.point_at(wanted[0])
    tasks = [
        task
        for rtpu in rtpus
        for task in rtpu.tasks
        if not wanted or task.task in wanted
    ]
    profiles = desk.baselines.since(tasks)
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


def profiles(desk: Desk, given: Given) -> Data:
    """Show the profiles of tasks and of their RTPUs."""
    wanted: list[str] = given.get("task") or []
    found = desk.subsystem.profile(wanted)
    if len(wanted) == 1:
        desk.point_at(wanted[0])
    picture = desk.subsystem.picture
    tasks: list[Data] = []
    for one in found:
        member = picture.get(one.status.task)
        tasks.append(profiling.task_data(one, member.rmod if member else None))
    rtpus = [
        profiling.rtpu_data(status, tasks) for status in desk.subsystem.rtpu_status()
    ]
    return {"tasks": tasks, "rtpus": [one for one in rtpus if one["tasks"]]}


def profiles_save(desk: Desk, given: Given) -> Data:
    """Save the profiles of tasks."""
    saved = desk.subsystem.profile_save(given.get("task") or [])
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


def status_set(desk: Desk, given: Given) -> Data:
    """Choose the columns of status."""
    words: list[str] = given.get("field") or []
    if words:
        desk.shown = profile.columns(words)
    known = [
        {"name": field.name, "unit": field.unit, "doc": field.doc}
        for field in profile.FIELDS
    ]
    return {"shown": list(desk.shown), "known": known}


def display(desk: Desk, given: Given) -> Data:
    """Show variables."""
    values = desk.subsystem.display(
        given.get("variable"), task=given.get("task"), writer=given.get("writer")
    )
    return {"variables": [msgspec.to_builtins(value) for value in values]}


def write(desk: Desk, given: Given) -> Data:
    """Set a variable."""
    value = desk.subsystem.write(given["variable"], given["value"])
    return {"variables": [msgspec.to_builtins(value)]}


def module(desk: Desk, given: Given) -> Data:
    """List modules and RMODs, or show one module."""
    name: str | None = given.get("module")
    infos = desk.subsystem.module(name)
    if name is not None:
        return {"module": msgspec.to_builtins(infos[0])}
    return {
        "modules": [
            {"name": info.name, "version": info.version, "doc": info.doc}
            for info in infos
        ],
        "rmods": desk.subsystem.files.rmods(),
    }


def _number(word: int | str) -> int | str:
    return int(word) if str(word).isdecimal() else word


def events(desk: Desk, given: Given) -> Data:
    """Show what happened."""
    found = desk.subsystem.events(
        given.get("last", _LAST_EVENTS),
        since=_number(given.get("since", 0)),
        task=given.get("task"),
        code=given.get("code"),
        severity=given.get("severity"),
    )
    return {"events": [msgspec.to_builtins(event) for event in found]}


def events_count(desk: Desk, given: Given) -> Data:
    """Show how often each kind of event came."""
    return {"counts": desk.subsystem.events_count(given.get("task") or [])}


def help_(desk: Desk, given: Given) -> Data:
    """Show the commands."""
    return {
        "commands": [
            {
                "name": command.name,
                "usage": command.usage,
                "help": command.help,
                "changes": command.changes,
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
            for command in desk.subsystem.help(given.get("command"))
        ]
    }


def wait(desk: Desk, given: Given) -> Data:
    """Wait; a stop ends it."""
    desk.subsystem.wait(given["seconds"])
    return {}


def sigwait(desk: Desk, given: Given) -> Data:
    """Wait for a signal of a task."""
    sent = desk.subsystem.sigwait(
        given.get("signal") or (),
        task=_split(given.get("task")),
        timeout=given.get("timeout"),
    )
    desk.point_at(sent.task)
    return {"sent": msgspec.to_builtins(sent)}


def sigmask(desk: Desk, given: Given) -> Data:
    """Show or set the masks of signals."""
    return {
        "masks": desk.subsystem.sigmask(given.get("signal") or None, given.get("task"))
    }


def _split(word: str | None) -> list[str]:
    return [name for name in (word or "").split(",") if name]


def network(desk: Desk, given: Given) -> Data:
    """Hand control to a program on the network."""
    portname: str = given["portname"]
    if desk.hand_over is None:
        raise StateError(
            "this interface cannot hand control over",
            remedy="give the command at the prompt or in a script",
        )
    desk.hand_over(portname)
    return {"portname": portname}


def quit_(desk: Desk, _: Given) -> Data:
    """End the interface."""
    desk.ended = True
    return {}


def no_task(word: str, known: list[str]) -> PbonetError:
    """Return the error for a command that needs a task and has none."""
    return UnknownTaskError(
        f"the subsystem has no task {word}" if word else "no task is named",
        got="tasks: " + (", ".join(known) or "none"),
        remedy=did_you_mean(word, known) or "name one, or 'spawn' one first",
    )
