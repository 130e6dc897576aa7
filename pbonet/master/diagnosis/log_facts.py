"""Reads from the log of a run what `explain` needs."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from msgspec import structs

from pbonet.errors import PbonetError
from pbonet.log import Log, files_of, not_on, timelines
from pbonet.master.configuration import Graph, recorded_graph
from pbonet.xm.net import (
    Event,
    RtpuStatus,
    TaskStatus,
    VarValue,
    convert,
    event_codes,
)

from .facts import Facts, Gap

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from pbonet.log import Stretch

_GONE: Final = "NOT-CREATED"
_SAME: Final = 1e-3
"""Seconds by which times of one event may differ."""
_BREAK: Final = 1000
"""A longer gap, in periods, is time in which the task was OFF."""
_FAILED: Final = ("METHOD", "SIGNAL_FAILED", "TASK_DIED", "FORCED")
_LOST: Final = ("TASK_DIED", "FORCED")
"""Events that say that a process has ended, and not in order."""
_OUT_OF_ORDER: Final = ("FORCED", "LEFT_SAFE")
"""Events of a task that did not end in order, also amid the end of a run."""
_ENDING: Final = 10.0
"""Seconds within which the tasks of a run are turned off at its end."""
_EARLIER: Final = re.compile(
    r"(on|off|kill|clear|reinit): (ON|OFF|ERROR|NOT-CREATED)(?:: (.*))?", re.DOTALL
)
"""The text of a signal in older logs."""
_CHANGES: Final = re.compile(r"(?:\[\d+ changes\] )?(?:no longer: )?(.*)", re.DOTALL)


_Stamp: TypeAlias = tuple[tuple[str, int, int, int], ...]
_kept: dict[_Stamp, Facts] = {}
"""The facts of the log that was read last."""
_guard: Final = threading.Lock()


def read_log(path: str | Path) -> Facts:
    """Return the facts of a recorded run, as they were before its tasks were ended.

    A task whose process was ended by force, or died, has no process. The log that was
    read last is read again only when its files have changed.

    Args:
        path: The log, or the folder of a run.

    Raises:
        LogError: There is none, or it is damaged from the beginning.
    """
    with _guard:
        stamp = _stamp(path)
        facts = _kept.get(stamp)
        if facts is None:
            _kept.clear()
            facts = _kept[stamp] = _read(path)
        return structs.replace(facts, unknown=list(facts.unknown))


def _stamp(path: str | Path) -> _Stamp:
    """Return what changes with the files of a log."""
    return tuple(_state(file.absolute()) for file in files_of(Path(path)))


def _state(file: Path) -> tuple[str, int, int, int]:
    try:
        one = file.stat()
    except OSError:  # it was just removed; reading it says so
        return str(file), 0, 0, 0
    return str(file), one.st_ino, one.st_size, one.st_mtime_ns


def _read(path: str | Path) -> Facts:
    log = Log(path)
    unknown = [str(one) for one in log.check()]
    unknown += (
        []
        if log.complete
        else ["the end of the log: it was not finished, or is still written"]
    )
    events = [_event(one) for one in log.events()]
    try:
        graph = convert(recorded_graph(log)[0], Graph)
    except PbonetError as error:
        unknown.append(str(error))
        graph = Graph(
            name=log.about.get("subsystem", ""),
            job="",
            rtpus=[],
            tasks=[],
            variables=[],
            wires=[],
            links=[],
            faults=[],
        )
    end = _end_of(events)
    facts = Facts(
        subsystem=graph.name,
        graph=graph,
        events=[one for one in events if one.wall < end or one.code in _OUT_OF_ORDER],
        from_log=True,
        unknown=unknown,
    )
    over_time = timelines(log)
    facts.rtpus = _rtpus(log, facts, {k: _last(v, end) for k, v in over_time.items()})
    facts.on_since = _on_since(log, end)
    facts.withdrawn = _withdrawn(facts.events)
    facts.gaps = {task: _gaps(log, task, over_time.get(task, [])) for task in log.tasks}
    facts.recorded = {task: _recorded(log, task) for task in log.tasks}
    facts.values = _values(log, end)
    return facts


def _event(recorded: dict[str, Any]) -> Event:
    """Return a recorded event; what it says of a signal is in the present words."""
    event = convert(recorded, Event)
    if event.code in {"STATE", "SIGNAL_FAILED"} and (
        parts := _EARLIER.fullmatch(event.text)
    ):
        signal, state, failed = parts.groups("")
        event.text = event_codes.signal_text(signal, state, failed)
    return event


def _rtpus(log: Log, facts: Facts, states: dict[str, str]) -> dict[str, RtpuStatus]:
    """Return the status of each RTPU, with its tasks in these states."""
    missed, failed = log.missed(), log.failed()
    tasks: dict[str, list[TaskStatus]] = {}
    for name in log.tasks:
        about = log.task_about(name)
        state = _of_process(facts.events, name) or states.get(name, _GONE)
        status = _task(log, name, state, facts)
        status.miss, status.failed = missed.get(name, 0), failed.get(name, 0)
        tasks.setdefault(about.rtpu, []).append(status)
    names = dict.fromkeys([*(one.name for one in facts.graph.rtpus), *tasks])
    raised = _raised(facts.events)
    return {
        name: RtpuStatus(
            rtpu=name,
            backend="",
            scheduler="",
            tasks=tasks.get(name, []),
            illegal=raised.get(name, []),
        )
        for name in names
        if name in tasks or name in raised
    }


def _last(line: list[Any], end: float) -> str:
    """Return the last state of a task before it was ended in order."""
    states = [one.state for one in line if one.begin_ns * 1e-9 < end - _SAME]
    before = states[:-1] if len(states) > 1 and states[-1] == _GONE else states
    return before[-1] if before else _GONE


def _of_process(events: list[Event], task: str) -> str:
    """Return the state of a task whose newest event is the begin or loss of a process.

    Such events have no state of their own. Empty: another one is newer.
    """
    for event in reversed(events):
        if event.task == task:
            if event.code in _LOST:
                return _GONE
            if event.code == "SPAWNED":
                return "OFF"
            if event.state not in {"", _GONE}:
                return ""
    return ""


def _on_since(log: Log, end: float) -> dict[str, float]:
    """Return when each task was turned on for the last time before the end."""
    begun = {
        name: [one.begin_ns * 1e-9 for one in line if one.state == "ON"]
        for name, line in timelines(log).items()
    }
    before = {name: [at for at in ats if at < end] for name, ats in begun.items()}
    return {name: ats[-1] for name, ats in before.items() if ats}


def _task(log: Log, name: str, state: str, facts: Facts) -> TaskStatus:
    about, arrays = log.task_about(name), log.arrays(name)
    failures = facts.news(_FAILED, task=name)
    error = failures[0].text if failures and state in {"ERROR", _GONE} else ""
    cpu = arrays["cpu_ns"]
    return TaskStatus(
        rmod=name,
        task=name,
        rtpu=about.rtpu,
        tid=0,
        S="P",
        crit=0,
        state=state,
        cycle=len(cpu),
        miss=0,
        ref_f=about.freq or 0.0,
        mez_f=0.0,
        mez_t=0.0,
        ptime=0.0,
        tot_c=float(cpu.sum()) * 1e-9,
        tick=0.0,
        min_c=float(cpu.min(initial=0)) * 1e-9,
        max_c=float(cpu.max(initial=0)) * 1e-9,
        last_c=0.0,
        warn=0,
        error=error,
        on_ns=1 if len(cpu) else 0,
    )


def _raised(events: list[Event]) -> dict[str, list[str]]:
    """Return the causes of the flag in the run, by the RTPU that has reported them."""
    found: dict[str, dict[str, None]] = {}
    for event in events:
        if event.code == "ILLEGAL":
            found.setdefault(event.rtpu, {})[_changed(event)] = None
    return {rtpu: list(causes) for rtpu, causes in found.items()}


def _changed(event: Event) -> str:
    """Return the cause that an event of the flag is about."""
    parts = _CHANGES.fullmatch(event.text)
    return parts[1] if parts is not None else event.text


def _withdrawn(events: list[Event]) -> dict[str, tuple[Event, Event]]:
    """Return the causes of the flag that were withdrawn wherever they were raised."""
    first: dict[str, Event] = {}
    last: dict[tuple[str, str], Event] = {}
    for event in events:
        if event.code in {"ILLEGAL", "LEGAL"}:
            cause = _changed(event)
            first.setdefault(cause, event)
            last[cause, event.rtpu] = event
    found: dict[str, tuple[Event, Event]] = {}
    for cause, raised in first.items():
        ends = [event for (text, _), event in last.items() if text == cause]
        if all(event.code == "LEGAL" for event in ends):
            found[cause] = raised, max(ends, key=lambda event: event.wall)
    return found


def _end_of(events: list[Event]) -> float:
    """Return when the tasks began to be turned off for good; infinity: never."""
    begun = float("inf")
    for event in reversed(events):
        if begun < float("inf") and event.wall < begun - _ENDING:
            break
        if event.code == "STOPPED":
            begun = event.wall
        elif event.code == "STATE":
            if event.text not in {event_codes.TURNED_OFF, event_codes.KILLED}:
                break
            if begun < float("inf"):
                begun = event.wall
    return begun


def _recorded(log: Log, task: str) -> list[range]:
    """Return the numbers of a task's cycles, in stretches without a hole."""
    cycles = log.arrays(task)["cycle"].astype(np.int64)
    stretches = np.split(cycles, np.flatnonzero(np.diff(cycles) != 1) + 1)
    return [range(int(one[0]), int(one[-1]) + 1) for one in stretches if len(one)]


def _gaps(log: Log, task: str, states: list[Stretch]) -> list[Gap]:
    """Return where a task that was ON has missed releases, from its cycles' times."""
    arrays = log.arrays(task)
    releases: NDArray[np.int64] = arrays["release_ns"]
    between = np.diff(releases)
    if not len(between):
        return []
    period = float(np.median(between))
    counts = np.round(between / period).astype(np.int64) - 1 if period else between * 0
    # Cycles that were done and are not in the log are not missed, nor is what lies
    # before a number that is not higher: the task was spawned again.
    numbers = np.diff(arrays["cycle"].astype(np.int64))
    counts = np.where(numbers > 0, counts - numbers + 1, 0)
    away = not_on(releases + log.epoch_ns, states)
    offset = log.begin_time_ns - log.begin_ns
    places = np.flatnonzero((counts > 0) & (counts < _BREAK) & ~away)
    found: list[Gap] = []
    for place in places.tolist():
        release, end = int(releases[place]), int(arrays["end_ns"][place])
        if end > release + period:  # its cycle went on; else the next never began
            ready, until = release, end
        else:
            ready, until = release + round(period), int(releases[place + 1])
        used = dict(_core_use(log, task, ready, until))
        found.append(
            Gap(
                cycle=int(arrays["cycle"][place + 1]),
                missed=int(counts[place]),
                at=float(release + offset) * 1e-9,
                longest=float(arrays["cpu_ns"][place]) * 1e-9,
                window=(until - ready) * 1e-9,
                own=used.pop(task, 0.0),
                others=tuple(sorted(used.items(), key=lambda one: -one[1])),
            )
        )
    return found


def _core_use(log: Log, task: str, begin: int, end: int) -> Iterator[tuple[str, float]]:
    """Yield the tasks of an RTPU with the CPU time that each had in an interval.

    Of a cycle that lies in it in part, that part of its CPU time is counted.
    """
    home = log.task_about(task).rtpu
    for other in log.tasks:
        if log.task_about(other).rtpu != home:
            continue
        arrays = log.arrays(other)
        starts, ends = arrays["start_ns"], arrays["end_ns"]
        inside = np.flatnonzero((ends > begin) & (starts < end))
        within = np.minimum(ends[inside], end) - np.maximum(starts[inside], begin)
        lasted = np.maximum(ends[inside] - starts[inside], 1)
        if spent := float((arrays["cpu_ns"][inside] * within / lasted).sum()) * 1e-9:
            yield other, min(spent, (end - begin) * 1e-9)


def _values(log: Log, ended: float) -> dict[str, VarValue]:
    """Return each variable with its last writer, and its age at the end of the run.

    Args:
        log: The log.
        ended: When its tasks began to be turned off.
    """
    _, end = log.span_ns
    end = int(min(end, ended * 1e9))
    found: dict[str, VarValue] = {}
    for task in log.tasks:
        releases = log.arrays(task)["release_ns"]
        last = (
            int(releases[-1]) + log.begin_time_ns - log.begin_ns if len(releases) else 0
        )
        for index, name in enumerate(log.variables(task)):
            age = max(end - last, 0) * 1e-9 if last else None
            before = found.get(name)
            if before is None or before.age is None or (age or 0.0) < before.age:
                found[name] = VarValue(
                    name=name,
                    index=index,
                    values=[],
                    units=log.unit(name),
                    writer=f"{log.task_about(task).rtpu}/{task}" if last else None,
                    age=age,
                )
    return found
