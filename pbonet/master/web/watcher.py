"""One thread that reads a subsystem for all browsers, however many there are.

It asks for the values that some browser wants twenty times a second, for all values and
the status twice a second, and hands on what has changed. Nothing is asked of a task.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import structs

from pbonet.errors import PbonetError, Severity
from pbonet.master.console import Follower
from pbonet.master.subsystem import EventFilter, Subsystem
from pbonet.xm.net import Event, messages as m

from .differences import States, Values
from .history import History
from .source import Source

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from pbonet.master.configuration import Place

    Data = dict[str, Any]

STATES: Final = 0.5
"""Seconds between two requests of the status, the events and all values."""
RETRY: Final = 1.0
"""Seconds between two attempts to reach the subsystem's agents."""
_LARGEST: Final = 64
"""Numbers of a variable whose history is kept though no browser watches it, at most."""

log = logging.getLogger("pbonet.master")


class Watcher(Source):
    """Reads a subsystem until it is closed.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        place: Where the subsystem is.
        hz: How often a second watched values are read.

    Raises:
        ConfigError: A file is missing or wrong.
    """

    def __init__(self, path: str | Path, place: Place, *, hz: float = 20.0) -> None:
        self._path = path
        self._place = place
        self._pause = 1.0 / hz
        made = self._made()
        job = made.files.job
        self.about = {
            "name": made.name,
            "job": job.name if job is not None else "",
            "hz": hz,
            "log": None,
        }
        self._graph: Data = msgspec.to_builtins(made.graph())
        self._planned = self._graph
        self.variables = frozenset(one["name"] for one in self._graph["variables"])
        self._told: Callable[[Data], None] = _unheard
        self._lock = threading.Lock()
        self._history = History()
        self._values = Values()
        self._states = States()
        self._wanted: frozenset[str] = frozenset()
        self._ended = threading.Event()
        self._look = threading.Event()
        self._complaints: list[str] = []
        self._shape: object = None
        self._count = itertools.count(1)
        self._last: dict[str, Data] = {}
        """The newest value of each variable."""
        self._thread = threading.Thread(target=self._run, name="watcher", daemon=True)

    def _made(self) -> Subsystem:
        """Return the subsystem, which is not open yet."""
        place = structs.replace(self._place, take_over=False, confirm=None)
        return Subsystem(
            self._path,
            **place.arguments,
            kind="web",
            watch=True,
            partly=True,
            warned=_unsaid,
        )

    def start(self, told: Callable[[Data], None]) -> None:
        """Begin to read."""
        self._told = told
        self._thread.start()

    def close(self) -> None:
        """Read no more."""
        self._ended.set()
        self._look.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def want(self, names: Iterable[str]) -> None:
        """Read these variables at the full rate from now on."""
        self._wanted = frozenset(names)

    def refresh_soon(self) -> None:
        """Read the status now, because a command was carried out."""
        self._look.set()

    def knows(self, task: str) -> bool:
        """Return whether the subsystem has such a task."""
        drawn = any(one["name"] == task for one in self._graph.get("tasks", ()))
        return drawn or task in self._states  # it was created a moment ago

    def first(self) -> list[Data]:
        """Return the first messages: graph, status, events, complaints."""
        with self._lock:
            return [
                {"kind": "graph", "graph": self._graph},
                self._states.whole(time.time()),
                {"kind": "history", "values": {}, "events": self._history.events},
                {"kind": "complaints", "texts": self._complaints},
            ]

    def history(self, names: Iterable[str]) -> list[Data]:
        """Return what is known of variables that a browser watches from now on."""
        names = list(names)
        with self._lock:
            values = self._history.values(names)
            now = {name: self._last[name] for name in names if name in self._last}
        return [
            {"kind": "history", "values": values, "events": []},
            {"kind": "values", "t": time.time(), "values": now},
        ]

    # -- in the watcher's thread ------------------------------------------------------

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                with self._made() as subsystem:
                    self._read(subsystem)
            except PbonetError as error:
                self._complain([str(error)])
            except Exception:  # the page must not stand still in silence
                log.exception("the watcher failed inside pbonet; it starts again")
            self._ended.wait(RETRY)

    def _read(self, subsystem: Subsystem) -> None:
        follower = Follower(subsystem, EventFilter.of({}))
        due = states = time.monotonic()
        while not self._ended.is_set():
            complaints: list[str] = []
            look = self._look.is_set() or due >= states
            try:
                self._read_values(subsystem, every=look)
            except PbonetError as error:
                complaints.append(str(error))
            if look:
                self._look.clear()
                states = due + STATES
                complaints += self._read_states(subsystem, follower)
                self._complain(list(dict.fromkeys(complaints)))
            due = max(due + self._pause, time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _read_values(self, subsystem: Subsystem, *, every: bool) -> None:
        wanted = self._wanted
        names = set(wanted)
        if every:
            variables = subsystem.files.table.variables
            names |= {one.name for one in variables if one.nelem <= _LARGEST}
        if not names:
            return
        request = m.Display(names=sorted(names))
        before = time.time()
        keeper = subsystem.files.sbs.keeper
        answer = subsystem.clients.call(keeper, request, list[m.VarValue])
        new = self._values.new(answer, (before + time.time()) / 2)
        if new:
            with self._lock:
                self._history.add_values({n: v for n, v in new.items() if v["t"]})
                self._last.update(new)
            self._told({"kind": "values", "t": time.time(), "values": new})

    def _read_states(self, subsystem: Subsystem, follower: Follower) -> list[str]:
        events = [_event(one, next(self._count)) for one in follower.take()]
        results, errors = subsystem.clients.each(lambda _: m.Status(), m.RtpuStatus)
        silent = [name for name in subsystem.clients.names if name not in results]
        with self._lock:
            self._history.add_events(events)
            message = self._states.new(results, silent, time.time())
        if events:
            self._told({"kind": "events", "events": events})
        if message["tasks"] or message["rtpus"] or message["gone"]:
            self._told(message)
        if results:  # of silent RTPUs nothing new is known
            self._redraw(subsystem, results)
        return sorted({*map(str, errors), *follower.complaints().values()})

    def _redraw(self, subsystem: Subsystem, statuses: dict[str, m.RtpuStatus]) -> None:
        """Send the graph when tasks came, went, changed state, or run elsewhere.

        Its faults depend on the states, too.
        """
        shape = [
            (one.task, one.rtpu, one.tid, one.state, one.ref_f, one.fallback_of)
            for status in statuses.values()
            for one in status.tasks
        ]
        if shape == self._shape:
            return
        subsystem.task_set.refresh(strict=False)
        graph: Data = msgspec.to_builtins(subsystem.graph())
        drawn = {one["name"] for one in graph["tasks"]}
        complete = drawn == {one[0] for one in shape}
        graph = graph if graph["tasks"] else self._planned
        self._shape = shape if complete else None  # it is drawn again at the next look
        if graph == self._graph:
            return
        with self._lock:
            self._graph = graph
        self._told({"kind": "graph", "graph": graph})

    def _complain(self, texts: list[str]) -> None:
        if texts != self._complaints:
            with self._lock:
                self._complaints = texts
            self._told({"kind": "complaints", "texts": texts})


def _event(event: Event, number: int) -> Data:
    """Return an event as a message has it; RTPUs number theirs apart."""
    data: Data = msgspec.to_builtins(event)
    data["n"] = number
    data["t"] = data.pop("wall")
    data["severity"] = Severity(event.severity).name.lower()
    return data


def _unheard(_: Data) -> None:
    """Drop a message, before there is a server."""


def _unsaid(_: str) -> None:
    """Leave out a warning that the page shows otherwise: an RTPU that is silent."""
