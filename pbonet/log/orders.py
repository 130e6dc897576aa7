"""The commands in a log: filtering, and formatting as text."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, cast

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

JsonObject = dict[str, Any]
_LONGEST = 60
"""Maximum length of one value in a line, in characters."""


def chosen(
    commands: Iterable[JsonObject],
    *,
    task: str | None = None,
    op: str | None = None,
    refused: bool = False,
) -> list[JsonObject]:
    """Return the commands that match.

    Args:
        commands: As returned by `Log.commands`.
        task: Only those that name this task, or stop all tasks; None: any.
        op: Only those of this kind; None: any.
        refused: Only those that were not carried out.
    """
    return [
        one
        for one in commands
        if (task is None or one["op"] == "stop" or task in tasks_of(one))
        and op in {None, one["op"]}
        and not (refused and failure(one) is None)
    ]


def none_of(about: JsonObject, commands: Sequence[JsonObject]) -> str:
    """Return a sentence why no command is shown.

    Args:
        about: The run, as in `Log.about`.
        commands: All commands of the log.
    """
    if commands:
        return f"none of the {len(commands)} commands matches"
    if about.get("seconds"):
        return (
            "no commands were sent: this run was simulated, and a simulation is "
            "controlled by its job or sequence alone; `log events` shows what happened"
        )
    return "the log has no commands; `log events` shows what happened"


def tasks_of(command: JsonObject) -> set[str]:
    """Return the tasks that a command names."""
    asked = _fields(command["asked"])
    found = {asked.get("task"), asked.get("original")}
    found |= {item[0] for item in asked.get("items", ()) if isinstance(item, list)}
    for name in ("tasks", "order", "replaces", "handover", "after"):
        found |= set(asked.get(name) or ())
    return {one for one in found if isinstance(one, str) and one}


def failure(command: JsonObject) -> str | None:
    """Return why a command was not carried out completely; None: it was."""
    error: object = command["error"]
    if command["ok"]:
        error = _fields(command["result"]).get("error")
        if not _fields(error):  # a status has the text of its task's error
            return None
    told = _fields(error)
    return f"{told.get('code', '')}: {told.get('what', '')}" if told else str(error)


def line(command: JsonObject) -> str:
    """Return a command as one line: when, where, client, command, and result."""
    clock = time.strftime("%H:%M:%S", time.localtime(command["wall"]))
    clock += f".{int(command['wall'] % 1 * 1000):03d}"
    took = (command["ended_ns"] - command["begun_ns"]) * 1e-6
    asked = " ".join(
        f"{name}={_short(value)}"
        for name, value in _fields(command["asked"]).items()
        if value not in (None, "", [], {}, False)
    )
    if isinstance(command["asked"], str):  # it was too long for a log
        asked = command["asked"]
    what = f"{command['op']} {asked}".rstrip()
    head = f"{clock} {command['rtpu']} {command['client']} {what}".replace("  ", " ")
    error = failure(command)
    if error is not None:
        return f"{head}: refused, {error}"
    warnings = command["warnings"]
    told = "".join(f"; {one}" for one in warnings if isinstance(warnings, list))
    return f"{head}: done in {took:.1f} ms{told}"


def _fields(value: object) -> JsonObject:
    """Return an object's fields; none if it is another type, or was too long."""
    return cast("JsonObject", value) if isinstance(value, dict) else {}


def _short(value: object) -> str:
    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
