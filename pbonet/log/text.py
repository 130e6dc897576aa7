"""Contents of a log as data and as text: summary, values, differences."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from pbonet.errors import LogError

from .damage import Lost
from .records import CLOCKS
from .states import not_on, timelines

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from .cycles import Cycles
    from .reader import Log
    from .states import Stretch

JsonObject = dict[str, Any]


def info(log: Log) -> JsonObject:
    """Return the content of a log: files, duration, and each task's figures."""
    log.load()
    damage = log.check()
    begin, end = log.span_ns
    lost, missed, states = log.lost(), log.missed(), timelines(log)
    failed = log.failed()
    events = log.events()
    return {
        "about": log.about,
        "seconds": (end - begin) / 1e9,
        "files": [
            {
                "path": str(part.path),
                "bytes": part.size,
                "complete": part.complete,
                "messages": part.count,
                "chunks": part.chunks,
                "damaged": len(part.damage),
            }
            for part in log.parts
        ],
        "damage": [msgspec.to_builtins(one) for one in damage],
        "clocks": [
            {"file": str(part.path), **clock.plain()}
            for part, clock in zip(log.parts, log.clocks, strict=True)
        ],
        "merged": [
            text
            for part in log.parts
            for name, values in part.metadata.items()
            if name.startswith(CLOCKS)
            for text in values.values()
        ],
        "sources": [
            {
                "file": str(part.path),
                **msgspec.to_builtins(one.about),
                "attached": one.attached,
            }
            for part in log.parts
            for one in part.sources
        ],
        "tasks": {
            task: task_info(log, task, missed.get(task), states.get(task, []))
            | {"failed": failed.get(task, 0), "lost": lost.get(task, 0)}
            | _over_time(states.get(task, []), begin)
            for task in log.tasks
        },
        "events": {
            code: sum(event["code"] == code for event in events)
            for code in sorted({event["code"] for event in events})
        },
        "attached": {name: len(one.data) for name, one in log.attached.items()},
    }


def _over_time(stretches: Sequence[Stretch], begin_ns: int) -> JsonObject:
    """Return a task's states: seconds in each, and when each began in the run."""
    total: dict[str, float] = {}
    for one in stretches:
        spent = (one.end_ns - one.begin_ns) * 1e-9
        total[one.state] = total.get(one.state, 0.0) + spent
    since = [[one.state, (one.begin_ns - begin_ns) / 1e9] for one in stretches]
    return {"states": total, "timeline": since}


def task_info(
    log: Log, task: str, counted: int | None, stretches: Sequence[Stretch]
) -> JsonObject:
    """Return the content of a log for one task.

    Args:
        log: The run.
        task: The task.
        counted: Missed releases as counted by its RTPU; None: they are estimated from
            the intervals between its cycles.
        stretches: Its states over time, if known.
    """
    about, arrays = log.task_about(task), log.arrays(task)
    releases = arrays["release_ns"]
    gaps = np.diff(releases)
    period = float(np.median(gaps)) if len(gaps) else 0.0
    missed = np.maximum(np.round(gaps / period) - 1, 0) if period else np.zeros(0)
    away = (missed > _BREAK) | not_on(releases + log.epoch_ns, stretches)
    delays = (arrays["start_ns"] - releases) * 1e-9
    return {
        "module": about.module,
        "rtpu": about.rtpu,
        "lives": len(log.lives(task)),
        "cycles": len(releases),
        "hz": 1e9 / period if period else 0.0,
        "freq": about.freq,
        "missed": int(missed[~away].sum()) if counted is None else counted,
        "gaps": int((np.diff(arrays["cycle"]) > 1).sum()),
        "longest": float(gaps[~away].max(initial=0)) * 1e-9,
        "jitter_max": float(delays.max()) if len(delays) else 0.0,
        "variables": log.variables(task),
        "tried": about.tried,
    }


_BREAK = 1000
"""A longer gap, in periods, counts as time in which the task was OFF."""


def info_text(data: JsonObject) -> str:
    """Return the result of `info` as text."""
    about = data["about"]
    lines = [
        f"run {about.get('run', '?')}, job {about.get('job', '?')}, subsystem "
        f"{about.get('subsystem', '?')}, {data['seconds']:.1f} s",
        f"recorded by pbonet {about.get('pbonet', '?')} on {about.get('host', '?')}, "
        f"{about.get('begun', '?')}",
    ]
    for file in data["files"]:
        state = "complete" if file["complete"] else "not finished: see `log recover`"
        count = file["damaged"]
        damaged = f", {count} damaged part{'s' * (count > 1)}" if count else ""
        lines.append(
            f"{file['path']}: {file['bytes'] / 1e6:.2f} MB, "
            f"{file['messages']} messages in {file['chunks']} chunks{damaged}, {state}"
        )
    lines += [str(Lost(**one)) for one in data["damage"]]
    lines += _sources_text(data["sources"])
    lines += [one["text"] for one in data["clocks"] if one["matters"]]
    lines += [f"merged: {text}" for text in data["merged"]]
    head = f"{'task':<16}{'rtpu':<10}{'cycles':>9}{'Hz':>9}{'missed':>8}"
    lines += [
        "",
        f"{head}{'failed':>8}{'lost':>7}{'gaps':>6}{'longest':>11}  variables",
    ]
    for name, task in data["tasks"].items():
        row = f"{name:<16}{task['rtpu']:<10}{task['cycles']:>9}{task['hz']:>9.1f}"
        row += (
            f"{task['missed']:>8}{task['failed']:>8}{task['lost']:>7}{task['gaps']:>6}"
        )
        row += f"{1e3 * task['longest']:>8.2f} ms"
        lines.append(f"{row}  {' '.join(task['variables'])}")
    lines += _states_text(data["tasks"])
    tried = [
        (name, one) for name, task in data["tasks"].items() for one in task["tried"]
    ]
    lines += [f"{name} was replayed with {one}" for name, one in tried]
    if data["events"]:
        counts = ", ".join(f"{count} {code}" for code, count in data["events"].items())
        lines += ["", f"events: {counts}"]
    return "\n".join(lines)


def _sources_text(sources: Sequence[JsonObject]) -> Iterator[str]:
    """Yield the sources of merged files, each as a line."""
    counts = Counter(one["file"] for one in sources)
    for one in sources:
        if counts[one["file"]] > 1:
            part = f", part {one['part']}" if one["part"] > 1 else ""
            other = {k: v for k, v in one["attached"].items() if k != v}
            names = "".join(f", its {name} is {now}" for name, now in other.items())
            yield (
                f"made of run {one['run']}, subsystem {one['subsystem']}, "
                f"{one['rtpu'] or '?'} on {one['host'] or '?'}{part}{names}"
            )


_CHANGES = 8
"""Maximum number of changes of a task's state in `info_text`."""


def _states_text(tasks: JsonObject) -> list[str]:
    """Return the tasks' states as lines: seconds in each, and when each began."""
    known = {name: task for name, task in tasks.items() if task["states"]}
    if not known:
        return []
    states = ("ON", "OFF", "ERROR")
    head = "".join(f"{f's {state}':>10}" for state in states)
    lines = ["", f"{'task':<16}{head}  since s of the run"]
    for name, task in known.items():
        spent = [task["states"].get(state) for state in states]
        row = "".join(f"{'-' if s is None else f'{s:.2f}':>10}" for s in spent)
        since = [f"{at:.2f} {state}" for state, at in task["timeline"][:_CHANGES]]
        if (more := len(task["timeline"]) - _CHANGES) > 0:
            since.append(f"and {more} more")
        lines.append(f"{name:<16}{row}  {', '.join(since)}")
    return lines


def columns(log: Cycles, task: str, names: Sequence[str] = ()) -> JsonObject:
    """Return values of a task by column: time (s), cycle, then each element.

    Args:
        log: The run.
        task: The task.
        names: Variables or columns such as ``cpu_ns``; empty for all variables.

    Raises:
        LogError: The task has no such column.
    """
    arrays = log.arrays(task)
    found: dict[str, NDArray[Any]] = {
        "time": (arrays["release_ns"] - log.begin_ns) * 1e-9,
        "cycle": arrays["cycle"],
    }
    for name in names or log.variables(task):
        if name not in arrays:
            raise LogError(
                f"{task} has no {name} on record",
                expected=" or ".join(log.variables(task)),
                got=name,
                remedy="see `pbonet log info`",
            )
        values = arrays[name]
        if values.ndim == 1:
            found[name] = values
        elif values.shape[1] == 1:
            found[name] = values[:, 0]
        else:
            found |= {f"{name}[{i}]": values[:, i] for i in range(values.shape[1])}
    return found


def diff(one: Cycles, other: Cycles, tasks: Sequence[str] = ()) -> list[JsonObject]:
    """Compare two runs variable by variable, cycle by cycle.

    Each cycle is compared with that of the same place in the other run's record;
    ``first`` is its number in the first run, as everywhere: since the task was spawned.

    Args:
        one: A run.
        other: Another run.
        tasks: The tasks; empty for all tasks that both have.
    """
    both = [task for task in one.tasks if task in other.tasks]
    rows: list[JsonObject] = []
    for task in tasks or both:
        a, b = one.arrays(task), other.arrays(task)
        rows += [
            {"task": task, "variable": name, **_differ(a[name], b[name], a["cycle"])}
            for name in one.variables(task)
            if name in other.variables(task)
        ]
    return rows


def _differ(a: NDArray[Any], b: NDArray[Any], numbers: NDArray[Any]) -> JsonObject:
    cycles = min(len(a), len(b))
    row: JsonObject = {"cycles": [len(a), len(b)], "first": None, "largest": None}
    if a.shape[1:] != b.shape[1:] or a.dtype != b.dtype:
        return row | {"first": int(numbers[0]) if len(numbers) else 1}
    a, b = a[:cycles], b[:cycles]
    same = a == b
    if a.dtype.kind == "f":
        same |= np.isnan(a) & np.isnan(b)
    other = np.flatnonzero(~same.all(axis=tuple(range(1, same.ndim))))
    if len(other):
        row["first"] = int(numbers[other[0]])
        if a.dtype.kind in "fiu":
            row["largest"] = float(np.nanmax(np.abs(a.astype(float) - b.astype(float))))
    return row


def diff_text(rows: Iterable[JsonObject]) -> str:
    """Return the result of `diff` as text."""
    lines = [f"{'task':<16}{'variable':<16}{'cycles':>15}{'first':>9}{'largest':>13}"]
    for row in rows:
        cycles = "/".join(map(str, row["cycles"]))
        first = "same" if row["first"] is None else str(row["first"])
        largest = "" if row["largest"] is None else f"{row['largest']:.6g}"
        lines.append(
            f"{row['task']:<16}{row['variable']:<16}{cycles:>15}{first:>9}{largest:>13}"
        )
    return "\n".join(lines)
