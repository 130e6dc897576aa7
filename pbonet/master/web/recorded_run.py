"""A recorded run as a page shows it: at one time, which moves on or is chosen."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbonet.errors import Severity
from pbonet.log import Log
from pbonet.master.configuration import recorded_graph

from .history import EVENTS, SECONDS
from .recorded_states import RecordedStates
from .source import Source

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    Data = dict[str, Any]

PERIOD: Final = 0.05
"""Seconds between two messages while the run goes on."""
_STATES: Final = 0.5
_SAMPLES: Final = 1200
"""Samples of one variable in a message with earlier ones."""
_AT_ONCE: Final = 10
"""Samples of one variable in a message while the run goes on."""
_FASTEST: Final = 100.0


class RecordedRun(Source):
    """Tells browsers how a recorded run was at one time.

    Args:
        path: The log, or the folder of a run.

    Raises:
        LogError: There is no log, or it has no files from which it can be drawn.
    """

    def __init__(self, path: str | Path) -> None:
        self._log = Log(path)
        begin, end = (time_ns * 1e-9 for time_ns in self._log.span_ns)
        self._begin, self._end = begin, end
        self._graph, self._maxages = recorded_graph(self._log)
        self.about = {
            "name": self._graph["name"],
            "job": self._graph["job"],
            "hz": 1.0 / PERIOD,
            "log": {"file": str(path), "begin": begin, "end": end},
        }
        self.variables = frozenset(one["name"] for one in self._graph["variables"])
        self._written = {
            name for task in self._log.tasks for name in self._log.variables(task)
        }
        events = enumerate(self._log.events(), 1)
        self._events = [_event(one, number) for number, one in events]
        self._states = RecordedStates(self._log, self._graph)
        self._series: dict[str, tuple[NDArray[np.float64], NDArray[Any]]] = {}
        self._writers: dict[str, list[tuple[float, str]]] = {}
        self._at = begin
        self._speed = 0.0
        self._wanted: frozenset[str] = frozenset()
        self._lock = threading.Lock()
        self._moved = threading.Event()
        self._ended = threading.Event()
        self._told: Callable[[Data], None] = lambda _: None
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)

    def start(self, told: Callable[[Data], None]) -> None:
        """Show the beginning, and stand still."""
        self._told = told
        self._thread.start()

    def close(self) -> None:
        """Show nothing more."""
        self._ended.set()
        self._moved.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def want(self, names: Iterable[str]) -> None:
        """Tell the values of these variables from now on."""
        self._wanted = frozenset(names)

    def seek(self, at: float) -> None:
        """Show the run at a time, in seconds since 1970."""
        if at == at:  # a number, and not NaN  # noqa: PLR0124
            with self._lock:
                self._at = min(max(at, self._begin), self._end)
            self._moved.set()

    def play(self, speed: float) -> None:
        """Let the run go on so many times as fast as it was; 0 stands still."""
        if 0.0 <= speed <= _FASTEST:
            with self._lock:
                if speed and self._at >= self._end:
                    self._at = self._begin
                self._speed = speed
            self._moved.set()

    def first(self) -> list[Data]:
        """Return the first messages for a new browser."""
        with self._lock:
            at, speed = self._at, self._speed
        return [
            {"kind": "graph", "graph": self._graph},
            self._states.at(at),
            {"kind": "history", "values": {}, "events": self._until(at)},
            {"kind": "complaints", "texts": self._complaints()},
            {"kind": "at", "t": at, "speed": speed},
        ]

    def _complaints(self) -> list[str]:
        """Return what is damaged, and what the log does not hold."""
        return [*map(str, self._log.damage), *self._states.lacks]

    def history(self, names: Iterable[str]) -> list[Data]:
        """Return the minute before the present time, thinned out."""
        with self._lock:
            at = self._at
        return self._between(list(names), at - SECONDS, at, _SAMPLES)

    def _between(
        self, names: Iterable[str], begin: float, at: float, most: int
    ) -> list[Data]:
        """Return the values of a time, thinned out, and those at its end."""
        values: dict[str, Data] = {}
        for name in names:
            times, numbers = self._of(name)
            low, high = np.searchsorted(times, (begin, at), side="right")
            step = max(1, -(-int(high - low) // most))
            chosen = slice(int(low), int(high), step)
            values[name] = {
                "t": times[chosen].tolist(),
                "v": [np.ravel(one).tolist() for one in numbers[chosen]],
            }
        return [
            {"kind": "history", "values": values, "events": []},
            {"kind": "values", "t": at, "values": self._values(names, at)},
        ]

    # -- in its own thread ------------------------------------------------------------

    def _run(self) -> None:
        before, told = self._at, 0.0
        last = time.monotonic()
        while not self._ended.is_set():
            waited = PERIOD if self._speed else None
            jumped = self._moved.wait(waited)
            self._moved.clear()
            now = time.monotonic()
            with self._lock:
                if not jumped:
                    self._at += (now - last) * self._speed
                if self._at >= self._end:
                    self._at, self._speed = self._end, 0.0
                at, speed = self._at, self._speed
            last = now
            self._send(at, speed, before, whole=jumped or now - told >= _STATES)
            if jumped or now - told >= _STATES:
                told = now
            before = at

    def _send(self, at: float, speed: float, before: float, *, whole: bool) -> None:
        """Tell how it is at a time; the status and earlier values only now and then."""
        self._told({"kind": "at", "t": at, "speed": speed})
        if whole:
            self._told(self._states.at(at))
        if at < before or at - before > SECONDS:  # another part of the run
            for message in self.history(sorted(self._wanted)):
                self._told({**message, "anew": True})
            self._told({"kind": "history", "values": {}, "events": self._until(at)})
            return
        events = [one for one in self._events if before < one["t"] <= at]
        if events:
            self._told({"kind": "events", "events": events})
        self._told({
            "kind": "values",
            "t": at,
            "values": self._values(self._wanted, at),
        })

    def _until(self, at: float) -> list[Data]:
        return [one for one in self._events if one["t"] <= at][-EVENTS:]

    def _values(self, names: Iterable[str], at: float) -> dict[str, Data]:
        """Return the values of variables as they were at a time.

        Those that no task of the log has written are left out.
        """
        found: dict[str, Data] = {}
        for name in names:
            if name not in self._written:
                continue
            times, numbers = self._of(name)
            row = int(np.searchsorted(times, at, side="right")) - 1
            when = float(times[row]) if row >= 0 else None
            age = at - when if when is not None else None
            maxage = self._maxages.get(name)
            found[name] = {
                "t": when,
                "v": np.ravel(numbers[row]).tolist() if row >= 0 else [],
                "writer": self._writer(name, at) if row >= 0 else "",
                "age": age,
                "stale": maxage is not None and (age is None or age > maxage),
            }
        return found

    def _writer(self, name: str, at: float) -> str:
        """Return the task that wrote a variable last before a time."""
        if name not in self._writers:
            begin = self._log.begin_time_ns * 1e-9
            each = self._log.writers(name)
            self._writers[name] = [(begin + since, task) for since, task in each]
        before = [task for since, task in self._writers[name] if since <= at]
        return before[-1] if before else ""

    def _of(self, name: str) -> tuple[NDArray[np.float64], NDArray[Any]]:
        """Return a variable's times, in seconds since 1970, and its values."""
        if name not in self._written:
            return np.zeros(0), np.zeros((0, 1))
        if name not in self._series:
            seconds, numbers = self._log.series(name)
            self._series[name] = seconds + self._log.begin_time_ns * 1e-9, numbers
        return self._series[name]


def _event(event: Data, number: int) -> Data:
    data = {**event, "n": number}
    data["t"] = data.pop("wall", 0.0)
    data["severity"] = Severity(data["severity"]).name.lower()
    return data
