"""The states of tasks over time, from the events of a log."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from .reader import Log

GONE: Final = "NOT-CREATED"
ON: Final = "ON"


class Stretch(NamedTuple):
    """An interval in which a task was in one state; nanoseconds since 1970."""

    state: str
    begin_ns: int
    end_ns: int


def timelines(log: Log) -> dict[str, list[Stretch]]:
    """Return the consecutive states of each task, by name.

    A task's first state is that after its first recorded event; its last one lasts to
    the end of the log.
    """
    changes: dict[str, list[tuple[str, int]]] = {}
    homes: dict[str, tuple[str, str]] = {}
    for one in log.messages("json", "/events"):
        event = cast("dict[str, Any]", msgspec.json.decode(one.data)["event"])
        task, state = event.get("task", ""), event.get("state", "")
        task = task and log.name_of(event.get("subsystem", ""), task)
        if task and state:
            homes[task] = event.get("subsystem", ""), event["rtpu"]
            changes.setdefault(task, []).append((state, one.time_ns))
        elif event["code"] == "STOPPED":
            stopped = event.get("subsystem", ""), event["rtpu"]
            for name, home in homes.items():
                if home == stopped or (not stopped[0] and home[1] == stopped[1]):
                    changes[name].append((GONE, one.time_ns))
    _, end = log.span_ns
    return {task: _stretches(found, end) for task, found in changes.items()}


def not_on(releases: NDArray[Any], stretches: Iterable[Stretch]) -> NDArray[np.bool_]:
    """Return for each interval of releases whether the task was not ON in between.

    Args:
        releases: When its cycles were released, ascending, in ns since 1970, [n].
        stretches: Its states over time.
    """
    found = np.zeros(max(len(releases) - 1, 0), bool)
    for one in stretches:
        if one.state != ON:
            found |= (releases[:-1] < one.end_ns) & (releases[1:] > one.begin_ns)
    return found


def _stretches(changes: list[tuple[str, int]], end_ns: int) -> list[Stretch]:
    """Return the intervals between actual changes of state."""
    found: list[Stretch] = []
    for state, at in changes:
        if found and found[-1].state == state:
            continue
        if found:
            found[-1] = found[-1]._replace(end_ns=at)
        found.append(Stretch(state, at, end_ns))
    return found
