"""An agent's view of its RTPU: from shared memory, without waking any process.

The core table and the state variable tables are read there; the little that only the
RTPU process knows, it has sent before (`rtpu_snapshot`). So the agent alone reports
status, profiles and values of variables, and sets variables for an operator
(Stewart 1994, sections 4.4.1, 4.5 and 6.7.1).
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from pbonet import tbuf
from pbonet.analysis.schedule import Kind
from pbonet.errors import (
    NodeError,
    ProtocolError,
    Severity,
    StateError,
    SvarError,
)
from pbonet.io import drivers
from pbonet.node import rt
from pbonet.node.rtpu import (
    SnapshotChanges,
    TaskSnapshot,
    claims,
    no_table,
    remove_unused,
    rtpu_snapshot,
    status,
    table_name,
)
from pbonet.node.wire import Answers, Note, being_stopped, core_trace, event_log
from pbonet.svar import Table
from pbonet.tbuf import places
from pbonet.xm.net import codec, messages as m

from . import variable_values
from .machine_state import machine_info

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from pbonet.analysis.schedule import SlotStatus
    from pbonet.config import Entry
    from pbonet.node.wire import Recorder, RtpuInfo

log = logging.getLogger("pbonet.node")

_ON = "ON"
"""State of a task that has cycles."""
FEW = 8
"""Maximum number of tasks and links, or of variables, that are read in less time than
waking a thread takes."""
NEWS_TIME = 2.0
"""Seconds in which the RTPU process reports a task that it has created or ended."""

Handled = (
    m.Status | m.Profile | m.TraceCore | m.Display | m.Write | m.Devices | m.Machine
)
HANDLED = (
    *(m.Status, m.Profile, m.TraceCore, m.Display, m.Write, m.Devices, m.Machine),
)
"""Requests that the agent carries out itself."""


class Age(NamedTuple):
    """The age of a variable."""

    variable: str
    seconds: float | None
    """None: it was never written."""
    stale: bool


class Seen(NamedTuple):
    """A task, and its entries in the core table at one time."""

    task: TaskSnapshot
    slot: SlotStatus
    signals: tuple[int, ...]


class SharedMemoryStatus:
    """The state of one RTPU, its tasks and its tables.

    Args:
        domain: The agent's domain.
        rtpu: The RTPU's name.
        note: Called with the report of a fault inside pbonet.
        recorder: Returns the state of a subsystem's recorder.
        notes: Returns what was done for tasks of a subsystem that were lost with an
            RTPU process before, as `TaskStatus.restarted`.
        devices: I/O devices of the machine.
        processors: Returns the special purpose processors of the machine.
        runs: The folder of the logs.
    """

    def __init__(
        self,
        domain: str,
        rtpu: str,
        note: Callable[[Note], None],
        recorder: Callable[[str], Recorder | None],
        notes: Callable[[str], Mapping[str, str]] = lambda _: {},
        *,
        devices: Mapping[str, Entry] | None = None,
        processors: Callable[[], list[m.SppStatus]] = list,
        runs: str = "runs",
    ) -> None:
        self._processors = processors
        self._recorder, self._notes = recorder, notes
        self._domain, self._rtpu = domain, rtpu
        self._links = places.StandingLinks(domain)
        self._answers = Answers(
            rtpu, lambda text: note(Note(int(Severity.ERROR), "INTERNAL", text))
        )
        self._news = threading.Condition()
        self._told = 0
        self._known = SnapshotChanges()
        self._core: rt.CoreTable | None = None
        self._tables: dict[str, tuple[Table, bool]] = {}
        self._started_ns = 0
        self._tracing = threading.Lock()
        self._do: dict[type[m.Request], Callable[[Any], object]] = {
            m.Status: lambda request: self._status(
                request, self._read_slots(), self._links.names()
            ),
            m.Profile: self._profile,
            m.TraceCore: self._trace_core,
            m.Display: self._display,
            m.Write: self._write,
            m.Devices: lambda _: drivers.listed(devices or {}),
            m.Machine: lambda _: machine_info(runs),
        }

    # -- reports of the RTPU process ---------------------------------------------------

    def informed(self, info: RtpuInfo) -> None:
        """Open the core table, and the tables that the RTPU process has open."""
        self._started_ns = info.started_ns
        if self._core is None:
            self._core = rt.CoreTable(info.core, member=False)
        for subsystem in self._tables.keys() - info.tables.keys():
            self._let_go(subsystem)
        for subsystem, use in info.tables.items():
            if subsystem not in self._tables:
                self._attach(subsystem, keep=use.keep)

    def learn(self, news: SnapshotChanges) -> None:
        """Store the changed parts of the state."""
        with self._news:
            for name in news.__struct_fields__:
                if (part := getattr(news, name)) is not None:
                    setattr(self._known, name, part)
            self._told += 1
            self._news.notify_all()

    def on(self) -> dict[str, list[str]]:
        """Return the tasks that are ON, for each subsystem that uses the RTPU."""
        known = self._known
        return {
            entry.subsystem: [
                task.task
                for task in known.tasks or ()
                if task.subsystem == entry.subsystem and task.state == _ON
            ]
            for entry in known.claims or ()
        }

    def written(self, subsystem: str, names: Iterable[str]) -> bool:
        """Return whether a task writes any of these variables, or it is not known."""
        found = self._tables.get(subsystem)
        try:
            return found is None or any(map(found[0].written, names))
        except SvarError:
            return True

    def let_go(self) -> None:
        """Close all tables, because the RTPU process has ended."""
        for subsystem in list(self._tables):
            self._let_go(subsystem)
        with self._news:  # wake the waiters: there will be no more reports
            core, self._core, self._known = self._core, None, SnapshotChanges()
            self._told += 1
            self._news.notify_all()
        if core is not None:
            core.close()

    def _attach(self, subsystem: str, *, keep: bool) -> None:
        try:
            table = Table.attach(table_name(self._domain, subsystem))
        except SvarError as error:
            log.warning("the table of %s cannot be attached: %s", subsystem, error)
        else:
            self._tables[subsystem] = table, keep

    def _let_go(self, subsystem: str) -> None:
        table, _ = self._tables.pop(subsystem)
        path = table.path
        table.close()
        remove_unused(path)

    # -- requests ----------------------------------------------------------------------

    def answer(self, request: Handled) -> bytes:
        """Return the packed answer to a request of a type in `HANDLED`."""
        return self._answer(request, partial(self._do[type(request)], request))

    def _answer(self, request: Handled, do: Callable[[], object]) -> bytes:
        try:
            result = do()
            return self._answers.good(request, result, [])
        except Exception as error:  # noqa: BLE001 - the server survives any request
            return self._answers.bad(request, error)

    def at_once(self, request: object) -> bytes | None:
        """Return the packed answer to a request that takes little time.

        None for other requests, and if the answer must wait for another process.
        """
        if isinstance(request, m.Display):
            few = request.names is not None and 0 < len(request.names) <= FEW
            return self.answer(request) if few else None
        if not isinstance(request, m.Status):
            return None
        tasks = self._known.tasks
        if tasks is None or self._core is None:
            return None
        links = self._links.names()
        if len(tasks) + len(links) > FEW:
            return None
        found = self._match(tasks)
        if len(found) < len(tasks):
            return None
        return self._answer(request, partial(self._status, request, found, links))

    def write_at_once(self, request: m.Write) -> bytes | None:
        """Set a variable and return the packed answer; None if the table is locked."""
        try:
            done = self._set(request, wait=False)
            return None if done is None else self._answers.good(request, done, [])
        except Exception as error:  # noqa: BLE001 - the server survives any request
            return self._answers.bad(request, error)

    def _status(
        self, request: m.Status, seen: list[Seen], links: list[str]
    ) -> m.RtpuStatus:
        whose, core = request.subsystem, self._open()
        entry = self._claim(whose)
        if request.reset:
            for one in self._of(request, seen):
                core.restart_extremes(one.task.slot)
        found = status.rtpu_status(
            self._rtpu,
            entry.scheduler if entry else "",
            core.status(),
            core.cpu_ns,
            tasks=[
                *(self._shown(one) for one in self._of(request, seen)),
                *self._died(request),
            ],
            spent_ns=sum(one.slot.cpu_total_ns for one in seen),
            illegal=self._causes(whose),
            events=event_log.by_task(self._known.counts or [], whose),
            tbufs=tbuf.seen(self._domain, links),
            recorder=self._recorder(whose),
        )
        if self._started_ns:
            found.age = (time.monotonic_ns() - self._started_ns) * 1e-9
        found.spps = self._processors()
        notes = self._notes(whose)
        for task in found.tasks:
            task.restarted = notes.get(task.task, "")
        return found

    def with_status(self, claim: m.Claim, answer: bytes, agent: m.AgentInfo) -> bytes:
        """Return the answer to a claim; if it was granted, with the status."""
        packs = codec.Codec()
        given = packs.answer(answer)
        status = packs.answer(self.answer(m.Status(subsystem=claim.subsystem)))
        if given.ok and status.ok:
            given.result |= {"status": status.result, "agent": agent}
        return packs.pack(given)

    def status(self, subsystem: str) -> m.RtpuStatus:
        """Return the status of a subsystem's tasks, for the metrics.

        Raises:
            NodeError: The RTPU process is being started again.
        """
        request = m.Status(subsystem=subsystem)
        return self._status(request, self._read_slots(), self._links.names())

    def ages(self, subsystem: str) -> list[Age]:
        """Return the ages of a subsystem's variables; none without its table."""
        found = self._tables.get(subsystem)
        if found is None:
            return []
        table = found[0]
        infos = [(name, table.info(name)) for name in table.names()]
        return [
            Age(name, None if i.age_ns is None else i.age_ns * 1e-9, i.stale)
            for name, i in infos
        ]

    def _profile(self, request: m.Profile) -> list[m.TaskProfile]:
        while True:
            found, core = self._of(request, self._read_slots()), self._open()
            with contextlib.suppress(NodeError):  # a task has ended: read again
                return [
                    status.task_profile(
                        self._shown(one), one.slot, core.histograms(one.task.slot)
                    )
                    for one in found
                ]

    def _trace_core(self, request: m.TraceCore) -> m.CoreTrace:
        """Follow the core; one request at a time, because each holds a thread."""
        if not 0 < request.seconds <= m.LONGEST_TRACE:
            raise ProtocolError(
                "a core cannot be followed for so long",
                expected=f"above 0, up to {m.LONGEST_TRACE:g} s",
                got=f"{request.seconds:g} s",
                remedy="give a shorter time, and repeat it",
            )
        core = self._open()
        seen = self._read_slots()
        (one,) = self._of(request, seen)
        if one.slot.kind is Kind.BACKGROUND:
            raise StateError(
                f"the background task {request.task} has no period, and misses nothing",
                where=self._rtpu,
                remedy="follow the core for another task",
            )

        def snapshot() -> SlotStatus:
            now = core.snapshot(one.task.slot)
            if now.pid != one.slot.pid:  # another task has its place
                raise StateError(
                    f"task {request.task} has ended while its core was followed",
                    where=self._rtpu,
                    remedy="repeat it when the task is ON again",
                )
            return now

        if not self._tracing.acquire(blocking=False):
            raise StateError(
                f"the core of {self._rtpu} is being followed for another request",
                where=self._rtpu,
                remedy="repeat it when that has ended",
            )
        try:
            return core_trace.follow(
                request.task,
                core.status,
                snapshot,
                names={each.slot.pid: each.task.task for each in seen},
                seconds=request.seconds,
            )
        finally:
            self._tracing.release()

    def _display(self, request: m.Display) -> list[m.VarValue]:
        return variable_values.display(self._table(request.subsystem)[0], request.names)

    def _write(self, request: m.Write) -> m.VarValue | None:
        return self._set(request, wait=True)

    def _set(self, request: m.Write, *, wait: bool) -> m.VarValue | None:
        claims.check(self._rtpu, self._claim(request.subsystem), request)
        if request.subsystem in (self._known.stopping or []):
            raise being_stopped(self._rtpu, request.subsystem)
        table, keep = self._table(request.subsystem)
        return variable_values.write(
            table, request.name, request.values, keep=keep, wait=wait
        )

    # -- reading -----------------------------------------------------------------------

    def _read_slots(self) -> list[Seen]:
        """Return all tasks with their entries in the core table.

        A slot with an unexpected task was reused just now: the RTPU process is about to
        report it, and its report is waited for briefly.

        Raises:
            NodeError: The RTPU process has ended.
        """
        while True:
            with self._news:
                self._open()
                told, tasks = self._told, self._known.tasks
            found = [] if tasks is None else self._match(tasks)
            if tasks is not None and len(found) == len(tasks):
                return found
            if not self._more(told):
                return found

    def _more(self, told: int) -> bool:
        """Wait for a new report; return whether it came in time."""
        with self._news:
            return self._news.wait_for(lambda: self._told > told, NEWS_TIME)

    def _match(self, tasks: list[TaskSnapshot]) -> list[Seen]:
        core = self._open()
        found: list[Seen] = []
        owner = f"{self._domain}/{self._rtpu}"
        for task in tasks:
            try:
                slot, signals = core.snapshot(task.slot), core.signals(task.slot)
            except NodeError:  # the slot has been freed
                continue
            if (slot.rtpu, slot.task) == (owner, f"{task.subsystem}/{task.task}"):
                found.append(Seen(task, slot, signals))
        return found

    def _of(
        self,
        request: m.Status | m.Profile | m.TraceCore,
        seen: list[Seen],
    ) -> list[Seen]:
        """Return the requested tasks.

        Raises:
            UnknownTaskError: There is no task of that name, and was none.
        """
        whose, name = request.subsystem, request.task
        own = [one for one in seen if whose in {"", one.task.subsystem}]
        found = [one for one in own if name in {None, one.task.task}]
        if name is None or found:
            return found
        tombs = self._died(request)
        if not isinstance(request, m.Status) or not tombs:
            tomb = tombs[0] if tombs else None
            names = [one.task.task for one in own]
            raise rtpu_snapshot.no_task(self._rtpu, whose, name, names, tomb)
        return []

    def _died(self, request: m.Status | m.Profile | m.TraceCore) -> list[m.TaskStatus]:
        """Return the last status of the requested tasks that have died."""
        return [
            tomb
            for whose, tomb in self._known.tombs or []
            if request.subsystem in {"", whose} and request.task in {None, tomb.task}
        ]

    def _shown(self, seen: Seen) -> m.TaskStatus:
        return status.task_status(self._rtpu, *seen)

    def _causes(self, subsystem: str) -> list[str]:
        """Return the causes for which the illegal-configuration flag is up."""
        whose = [subsystem] if subsystem else list(self._tables)
        return [
            f"{cause.cause} ({cause.raiser})"
            for table, _ in filter(None, map(self._tables.get, whose))
            for cause in table.illegal
        ]

    def _claim(self, subsystem: str) -> claims.Entry | None:
        entries = self._known.claims or []
        return next((one for one in entries if one.subsystem == subsystem), None)

    def _table(self, subsystem: str) -> tuple[Table, bool]:
        found = self._tables.get(subsystem)
        if found is None:
            raise no_table(subsystem)
        found[0].must_be_whole()
        return found

    def _open(self) -> rt.CoreTable:
        if self._core is None:
            raise restarting(self._rtpu)
        return self._core


def restarting(rtpu: str) -> NodeError:
    """Return the error for an RTPU whose process is being restarted."""
    return NodeError(
        "the RTPU process has ended and is being started again",
        where=rtpu,
        remedy="try again in a moment",
    )
