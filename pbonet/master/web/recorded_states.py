"""Tasks and RTPUs as they were at one time of a recorded run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pbonet.log import timelines

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from pbonet.log import Log

    Data = dict[str, Any]

GONE: Final = "NOT-CREATED"
_SECOND: Final = 1.0


class _Counts(NamedTuple):
    """Counts of a task by its RTPU, about once a second."""

    times: NDArray[np.float64]
    missed: NDArray[np.int64]
    failed: NDArray[np.int64]

    def since(
        self, what: NDArray[np.int64], born: float, begin: float, at: float
    ) -> int | None:
        """Return how much a count grew between two times; None: it was not counted.

        It counts from 0 since the task was spawned, at `born`.
        """
        first, last = np.searchsorted(self.times, (begin, at), side="right") - 1
        if last < 0 or self.times[last] < begin:
            return None
        before = int(what[first]) if first >= 0 and self.times[first] >= born else 0
        return int(what[last]) - before


class RecordedStates:
    """The status of tasks and RTPUs over time, as far as a log holds it.

    Counts of misses and failures are those of the log, once a second; CPU times are
    those of the recorded cycles. What a log does not hold is None.

    Args:
        log: The run.
        graph: Its graph.
    """

    def __init__(self, log: Log, graph: Data) -> None:
        self._lines = timelines(log)
        offset = log.begin_time_ns - log.begin_ns
        self._tasks = {one["name"]: one for one in graph["tasks"]}
        self._releases: dict[str, NDArray[np.float64]] = {}
        self._cpu: dict[str, NDArray[np.float64]] = {}
        for task in log.tasks:
            arrays = log.arrays(task)
            self._releases[task] = (arrays["release_ns"] + offset) * 1e-9
            if arrays["cpu_ns"].any():  # virtual time takes none
                self._cpu[task] = arrays["cpu_ns"] * 1e-9
        self._counts = _counts(log)
        self._flags = _flags(log.events())
        self._rtpus = [one["name"] for one in graph["rtpus"]]
        self.lacks = self._lacking()
        """Sentences about what cannot be shown."""

    def _lacking(self) -> list[str]:
        """Return what the log lacks, of tasks of which it has cycles."""
        recorded = sorted(self._tasks.keys() & self._releases.keys())
        found: list[str] = []
        for what, there in (
            ("misses and failures", self._counts.keys()),
            ("CPU times", self._cpu.keys()),
        ):
            lacking = [one for one in recorded if one not in there]
            if lacking:
                whose = "" if lacking == recorded else f" of {', '.join(lacking)}"
                found.append(f"the log holds no {what}{whose}")
        unseen = sorted(self._tasks.keys() - self._releases.keys())
        if unseen:
            found.append(f"the log holds no cycles of {', '.join(unseen)}")
        return found

    def at(self, at: float) -> Data:
        """Return the message with the status of all at a time."""
        tasks = [self._task(name, at) for name in self._tasks]
        return {
            "kind": "status",
            "t": at,
            "whole": True,
            "rtpus": [self._rtpu(name, at, tasks) for name in self._rtpus],
            "tasks": tasks,
            "gone": [],
        }

    def _rtpu(self, name: str, at: float, tasks: list[Data]) -> Data:
        shares = [
            one["fields"]["avgU"]
            for one in tasks
            if one["rtpu"] == name and one["state"] == "ON"
        ]
        known = [one for one in shares if one is not None]
        load = (
            {"load": sum(known) / 100.0} if known and len(known) == len(shares) else {}
        )
        up: dict[str, None] = {}
        for time, cause, raised in self._flags.get(name, ()):
            if time <= at and raised:
                up[cause] = None
            elif time <= at:
                up.pop(cause, None)
        return {"rtpu": name, "illegal": [*up], "silent": False, **load}

    def _task(self, name: str, at: float) -> Data:
        begun, state = self._state(name, at)
        about = self._tasks[name]
        return {
            "task": name,
            "rtpu": about["rtpu"],
            "state": state,
            "signals": [],
            "fields": self._fields(name, state, begun, at),
            "error": "",
            "warning": "",
            "waits": "",
            "standby": False,
            "fallback_of": about["fallback_of"],
            "restarted": "",
        }

    def _fields(self, name: str, state: str, begun: float, at: float) -> Data:
        freq = self._tasks[name]["freq"]
        fields: Data = dict.fromkeys((
            "mezF",
            "cycle",
            "miss",
            "failed",
            "avgU",
            "avgC",
            "maxC",
        ))
        fields["refF"] = freq or None
        times = self._releases.get(name)
        if times is not None:
            since, second, end = np.searchsorted(
                times, (begun, max(begun, at - _SECOND), at), side="right"
            )
            fields["cycle"] = int(end - since)
            if state == "ON":
                fields["mezF"] = int(end - second)
            if name in self._cpu and end > second:
                mean = float(self._cpu[name][second:end].mean())
                rate = freq or float(end - second)
                fields["avgC"] = mean
                fields["avgU"] = mean * rate * 100.0 if state == "ON" else 0.0
                fields["maxC"] = float(self._cpu[name][since:end].max())
        counted = self._counts.get(name)
        if counted is not None:
            born = self._born(name, begun)
            fields["miss"] = counted.since(counted.missed, born, begun, at)
            fields["failed"] = counted.since(counted.failed, born, begun, at)
        return fields

    def _born(self, name: str, begun: float) -> float:
        """Return when a task was spawned before a time; 0: it is not known."""
        ends = [
            one.end_ns * 1e-9 for one in self._lines.get(name, []) if one.state == GONE
        ]
        return max((end for end in ends if end <= begun), default=0.0)

    def _state(self, name: str, at: float) -> tuple[float, str]:
        """Return since when a task is in its state at a time, and that state."""
        for stretch in reversed(self._lines.get(name, [])):
            if stretch.begin_ns * 1e-9 <= at:
                return stretch.begin_ns * 1e-9, stretch.state
        return 0.0, GONE


def _counts(log: Log) -> dict[str, _Counts]:
    """Return what RTPUs counted, by task."""
    rows: dict[str, list[tuple[float, int, int]]] = {}
    for time_ns, task, counts in log.counted():
        row = time_ns * 1e-9, counts["missed"], counts["failed"]
        rows.setdefault(task, []).append(row)
    found: dict[str, _Counts] = {}
    for task, each in rows.items():
        times, *numbers = zip(*each, strict=True)
        missed, failed = (np.array(one, np.int64) for one in numbers)
        found[task] = _Counts(np.array(times), missed, failed)
    return found


def _flags(events: Iterable[Data]) -> dict[str, list[tuple[float, str, bool]]]:
    """Return by RTPU when which causes of the flag came (true) and went."""
    found: dict[str, list[tuple[float, str, bool]]] = {}
    for event in events:
        if event["code"] in {"ILLEGAL", "LEGAL"} and not event.get("task"):
            text = event["text"]
            if text.startswith("["):  # how often it has changed within a window
                text = text.partition("] ")[2]
            raised = event["code"] == "ILLEGAL"
            cause = text if raised else text.removeprefix("no longer: ")
            row = event.get("wall", 0.0), cause, raised
            found.setdefault(event["rtpu"], []).append(row)
    return found
