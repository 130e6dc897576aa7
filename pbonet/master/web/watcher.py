"""One thread that reads a subsystem for all browsers, however many there are.

It asks for the values that some browser wants twenty times a second, for all values and
the status twice a second, and hands on what has changed. Nothing is asked of a task.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import structs

from pbonet.errors import PbonetError, Severity, UnknownVariableError
from pbonet.master.console import Follower
from pbonet.master.subsystem import EventFilter, Subsystem
from pbonet.xm.net import Event, messages as m

from .differences import States, Values
from .history import History
from .present_job import PresentJob
from .source import Source

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pbonet.master.configuration import Files, Place

    Data = dict[str, Any]

STATES: Final = 0.5
"""Seconds between two requests of the status, the events and all values."""
JOBS: Final = 5.0
"""Seconds between two requests of the present job, unless something has changed."""
RETRY: Final = 1.0
"""Seconds between two attempts to reach the subsystem's agents."""
_LARGEST: Final = 64
"""Numbers of a variable whose history is kept though no browser watches it, at most."""

log = logging.getLogger("pbonet.master")

_Times = tuple[int, ...]


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
        self._graph: Data = msgspec.to_builtins(made.graph()) | {"missing": {}}
        self._graph["job"] = ""  # that it runs is not known yet
        self._present = PresentJob(made.files, place.libraries)
        self._read_from = _times(made.files)
        self.variables = frozenset(one["name"] for one in self._graph["variables"])
        self._unread: tuple[_Times, str] = (), ""
        """Files that were changed and cannot be read, by their times, and why."""
        self._job_due = 0.0
        self._unknown: frozenset[str] = frozenset()
        """Variables of the files that the running table does not have."""
        self._recheck = False
        """Whether another table may have been made since."""
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
        self._job_due = 0.0
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
                made = self._made()
                self._take_files(made.files)
                with made as subsystem:
                    self._read(subsystem)
            except PbonetError as error:
                self._complain([str(error)])
            except Exception:  # the page must not stand still in silence
                log.exception("the watcher failed inside pbonet; it starts again")
            self._ended.wait(RETRY)

    def _take_files(self, files: Files) -> None:
        """Show what the files say now: another table may have been written."""
        times = _times(files)
        if times == self._read_from:
            return
        self._read_from = times
        self._present = PresentJob(files, self._place.libraries)
        self._unknown = frozenset()
        self._shape = None
        with self._lock:
            self.variables = frozenset(one.name for one in files.table.variables)

    def _files_changed(self, files: Files) -> bool:
        """Return whether the files say something else now, and can be read."""
        times = _times(files)
        if times in {self._read_from, self._unread[0]}:
            return False
        try:
            self._made()
        except PbonetError as error:
            self._unread = times, str(error)
            return False
        self._unread = (), ""
        return True

    def _about_files(self) -> list[str]:
        """Return what there is to say of files and table that are not of one time."""
        found = (
            [f"{self._unread[1]} (shown as it was before)"] if self._unread[1] else []
        )
        if self._unknown:
            names = ", ".join(sorted(self._unknown))
            found.append(
                f"the table that runs was made before the .svar file had {names}: stop "
                "everything and start the job again, and it will have them"
            )
        return found

    def _read(self, subsystem: Subsystem) -> None:
        """Read it until the page ends, or a file of it has changed."""
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
                if self._files_changed(subsystem.files):
                    return
                self._look.clear()
                states = due + STATES
                complaints += self._read_states(subsystem, follower)
                complaints += self._about_files()
                self._complain(list(dict.fromkeys(complaints)))
            due = max(due + self._pause, time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _read_values(self, subsystem: Subsystem, *, every: bool) -> None:
        wanted = self._wanted
        names = set(wanted)
        if every:
            variables = subsystem.files.table.variables
            names |= {one.name for one in variables if one.nelem <= _LARGEST}
        names -= frozenset() if self._recheck else self._unknown
        if not names:
            return
        before = time.time()
        try:
            answer = self._display(subsystem, sorted(names))
        except UnknownVariableError:  # the table is older than the .svar file
            there = {one.name for one in self._display(subsystem, None)}
            self._unknown, self._recheck = frozenset(names - there), False
            return
        if self._recheck:
            self._unknown, self._recheck = frozenset(), False
        new = self._values.new(answer, (before + time.time()) / 2)
        if new:
            with self._lock:
                self._history.add_values({n: v for n, v in new.items() if v["t"]})
                self._last.update(new)
            self._told({"kind": "values", "t": time.time(), "values": new})

    def _display(
        self, subsystem: Subsystem, names: list[str] | None
    ) -> list[m.VarValue]:
        """Return variables of the table; all if none are named."""
        keeper = subsystem.files.sbs.keeper
        request = m.Display(names=names)
        return subsystem.clients.call(keeper, request, list[m.VarValue])

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
        now = time.monotonic()
        if shape == self._shape and now < self._job_due:
            return
        self._job_due = now + JOBS
        self._recheck = self._recheck or shape != self._shape
        if not self._present.ask(subsystem) and shape == self._shape:
            return
        subsystem.task_set.refresh(strict=False)
        drawn = subsystem.graph()
        complete = {one.name for one in drawn.tasks} == {one[0] for one in shape}
        graph = self._present.complete(drawn, statuses)
        self._shape = shape if complete else None  # it is drawn again the next time
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


def _times(files: Files) -> _Times:
    """Return when the files of a subsystem were written; 0: one is not there."""
    paths = [files.path, Path(files.table.file)]
    paths += [Path(files.job.file)] if files.job is not None else []
    found: list[int] = []
    for path in paths:
        try:
            found.append(path.stat().st_mtime_ns)
        except OSError:
            found.append(0)
    return tuple(found)


def _unheard(_: Data) -> None:
    """Drop a message, before there is a server."""


def _unsaid(_: str) -> None:
    """Leave out a warning that the page shows otherwise: an RTPU that is silent."""
