"""What each command does: from its arguments to plain data, through `Subsystem`."""

from __future__ import annotations

import fnmatch
import threading
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from pbonet import verify
from pbonet.errors import (
    ConfigError,
    PbonetError,
    SeveralError,
    StateError,
    UnknownTaskError,
    UnknownVariableError,
    VerificationError,
    did_you_mean,
)
from pbonet.master import following, profile, profiling

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
        text: str = given.get("text") or ""
        if len(tasks) == 1:
            status = desk.subsystem.control(tasks[0], name, text)
            return {"states": {tasks[0]: status.state}}
        if text:
            raise StateError(
                "a text goes to one task",
                expected=f"{name} TASK text=...",
                got=f"{len(tasks)} tasks",
            )
        return {"states": desk.subsystem.reconfig([(task, name) for task in tasks])}

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
    dry_run = given.get("dry_run", False)
    return _transition(desk.subsystem.switch(given.get("job"), dry_run=dry_run))


def _transition(found: Transition) -> Data:
    data: Data = msgspec.to_builtins(found)
    return data


def start(desk: Desk, given: Given) -> Data:
    """Assemble a job."""
    statuses = desk.subsystem.start(given.get("job"))
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
    fields = columns([given["fields"]]) if given.get("fields") else desk.shown
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
                "stalls": rtpu.stalls,
                "stalled": rtpu.stalled,
            }
            for rtpu in rtpus
        ],
    }


def profiles(desk: Desk, given: Given) -> Data:
    """Show the profiles of tasks and of their RTPUs."""
    wanted: list[str] = given.get("task") or []
    found = desk.subsystem.profiles(wanted)
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
    saved = profiling.save(desk.subsystem.crew, given.get("task") or [])
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
        desk.shown = columns(words)
    known = [
        {"name": field.name, "unit": field.unit, "doc": field.doc}
        for field in profile.FIELDS
    ]
    return {"shown": list(desk.shown), "known": known}


def columns(words: list[str]) -> tuple[str, ...]:
    """Return the columns that words name; they may hold several with commas.

    Raises:
        StateError: One of them is no field.
    """
    names = [name for word in words for name in word.split(",") if name]
    if names == ["all"]:
        return profile.NAMES
    if names == ["default"]:
        return profile.DEFAULT
    for name in names:
        if name not in profile.NAMES:
            raise StateError(
                f"status has no field {name}",
                expected="names out of " + " ".join(profile.NAMES),
                remedy=did_you_mean(name, profile.NAMES),
            )
    return tuple(dict.fromkeys(names))


def display(desk: Desk, given: Given) -> Data:
    """Show variables."""
    patterns: list[str] = given.get("variable") or []
    known = [variable.name for variable in desk.subsystem.files.table.variables]
    names = known if not patterns else _matching(patterns, known)
    if given.get("task"):
        ports = desk.subsystem.picture.find(given["task"]).variables
        names = [name for name in names if name in ports]
    values = desk.subsystem.display(names)
    if given.get("writer"):
        values = [value for value in values if value.writer == given["writer"]]
    return {"variables": [msgspec.to_builtins(value) for value in values]}


def _matching(patterns: list[str], known: list[str]) -> list[str]:
    found: list[str] = []
    for pattern in patterns:
        names = [name for name in known if fnmatch.fnmatchcase(name, pattern)]
        if not names:
            raise UnknownVariableError(
                f"the table has no variable {pattern}",
                remedy=did_you_mean(pattern, known) or "'display' shows them all",
            )
        found += [name for name in names if name not in found]
    return found


def write(desk: Desk, given: Given) -> Data:
    """Set a variable."""
    value = desk.subsystem.write(given["variable"], given["value"])
    return {"variables": [msgspec.to_builtins(value)]}


def module(desk: Desk, given: Given) -> Data:
    """List modules and RMODs, or show one module."""
    name: str | None = given.get("module")
    infos = desk.subsystem.modules(name)
    if name is not None:
        return {"module": msgspec.to_builtins(infos[0])}
    return {
        "modules": [
            {"name": info.name, "version": info.version, "doc": info.doc}
            for info in infos
        ],
        "rmods": desk.subsystem.files.rmods(),
    }


def events(desk: Desk, given: Given) -> Data:
    """Show what happened."""
    wanted = following.Choice.of(given)
    found = list(filter(wanted, desk.subsystem.events(given.get("since") or 0)))
    last: int = given.get("last", _LAST_EVENTS)
    shown = found[max(0, len(found) - last) :]
    return {"events": [msgspec.to_builtins(event) for event in shown]}


def events_count(desk: Desk, given: Given) -> Data:
    """Show how often each kind of event came."""
    wanted: list[str] = given.get("task") or []
    for task in wanted:
        desk.subsystem.picture.find(task)
    return {
        "counts": [
            {"rtpu": rtpu.rtpu, "task": task, "code": code, "count": count}
            for rtpu in desk.subsystem.rtpu_status()
            for task, codes in sorted(rtpu.events.items())
            for code, count in sorted(codes.items())
            if not wanted or task in wanted
        ]
    }


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
            for command in desk.commands(given.get("command"))
        ]
    }


def wait(desk: Desk, given: Given) -> Data:
    """Wait; a stop ends it."""
    seconds: float = given["seconds"]
    if not 0 <= seconds <= threading.TIMEOUT_MAX:
        raise StateError(
            "nobody can wait so long",
            expected=f"0 to {threading.TIMEOUT_MAX:g} s",
            got=f"{seconds:g} s",
        )
    desk.subsystem.stopped.clear()
    desk.subsystem.stopped.wait(seconds)
    return {}


def sigwait(desk: Desk, given: Given) -> Data:
    """Wait for a signal of a task."""
    timeout: float | None = given.get("timeout")
    if timeout is not None and not 0 <= timeout <= threading.TIMEOUT_MAX:
        raise StateError(
            "this is no time limit",
            expected=f"0 to {threading.TIMEOUT_MAX:g} s",
            got=f"{timeout:g} s",
        )
    sent = desk.subsystem.sigwait(
        given.get("signal") or (), tasks=_split(given.get("task")), timeout=timeout
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
