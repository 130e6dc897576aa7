"""Signals and events that tasks send to a program (section 4.4.4).

Every task counts its signals; what a program has not taken yet is *pending*, however
long ago it was sent and however often. So nothing is missed between two waits.
"""

from __future__ import annotations

from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Lock
from typing import TYPE_CHECKING

import zenoh
from msgspec import Struct

from pbonet.errors import StateError, did_you_mean
from pbonet.pbo import PREDEFINED
from pbonet.xm.net import key_expressions

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Sequence

    from pbonet.master.configuration import TaskModel
    from pbonet.xm.net import messages as m, rpc

    from .rtpu_clients import RtpuClients


LOOK_TIME = 0.5
"""Seconds after which a wait checks the counts without an event."""
LATE_NS = 60_000_000_000
"""A status is late by less than this; an older one is of a machine that was booted
again, whose clock begins at 0."""
_FIRST = ("SHUTDOWN", "ERROR")
"""Signals that are handed out before others."""


class Sent(Struct, frozen=True):
    """A signal that a task has sent."""

    task: str
    signal: str
    count: int
    """How often it was sent since it was taken last."""
    rtpu: str


class _SeenTask(Struct):
    """Signals and events of one task since its spawn."""

    tid: int
    since: int
    """When it was first seen, in nanoseconds."""
    counts: dict[str, int]
    """As they were seen last."""
    pending: dict[str, int] = {}
    """Sent and not taken; of a task that died also by those before it."""
    died: int = 0
    """When it was last seen to have died; 0: not."""
    seen: int = 0
    """When it was seen last."""
    buried: bool = False
    """It was killed, or is to be."""

    def is_late(self, status: m.TaskStatus) -> bool:
        """Return whether a status is older than the task's spawn or death."""
        if self.seen - status.now > LATE_NS:
            return False
        before = bool(self.died and status.tid and status.tid == self.tid)
        return before or status.now < self.since

    def is_other(self, status: m.TaskStatus) -> bool:
        """Return whether a status is that of a task that was spawned again."""
        if self.seen - status.now > LATE_NS:
            return True
        if status.tid:
            return bool(self.died) or status.tid != self.tid
        if self.died:
            return status.now != self.died
        return any(status.signals.get(k, 0) < n for k, n in self.counts.items())


class Inbox:
    """Which signals of the tasks are pending: those counted, less those taken.

    It reads each status that comes, so that a task which dies and is spawned again
    between two waits takes nothing with it.
    """

    def __init__(self) -> None:
        self._lives: dict[tuple[str, str], _SeenTask] = {}
        self._busy = Lock()

    def begin(self, statuses: Iterable[m.TaskStatus]) -> None:
        """Take everything that was sent so far."""
        with self._busy:
            for status in statuses:
                self._note(status)
                self._lives[status.rtpu, status.task].pending.clear()

    def note(self, status: m.TaskStatus) -> None:
        """Count what a task has sent since its last status."""
        with self._busy:
            self._note(status)

    def dead(self) -> dict[str, str]:
        """Return the tasks that have died and were not killed, and the RTPU of each."""
        with self._busy:
            return {
                task: rtpu
                for (rtpu, task), life in self._lives.items()
                if life.died and not life.buried
            }

    def bury(self, tasks: Iterable[str]) -> None:
        """Forget pending signals of tasks that were killed."""
        names = set(tasks)
        with self._busy:
            for (_, task), life in self._lives.items():
                if task in names:
                    life.buried = True
                    life.pending.clear()

    def clear(self) -> None:
        """Forget all tasks, for they have been stopped."""
        with self._busy:
            self._lives.clear()

    def pending(self, statuses: Iterable[m.TaskStatus]) -> list[Sent]:
        """Return the pending signals, the most urgent first."""
        with self._busy:
            return self._pending(statuses)

    def take(
        self,
        statuses: Iterable[m.TaskStatus],
        signals: Sequence[str],
        tasks: Sequence[str],
    ) -> Sent | None:
        """Take the first pending one of some signals of some tasks; empty: of all."""
        with self._busy:
            for sent in self._pending(statuses):
                if signals and sent.signal not in signals:
                    continue
                if not tasks or sent.task in tasks:
                    del self._lives[sent.rtpu, sent.task].pending[sent.signal]
                    return sent
        return None

    def forget(self, *, but: Sequence[str] = ()) -> None:
        """Take everything that is pending, except signals of some names."""
        with self._busy:
            for life in self._lives.values():
                life.pending = {k: n for k, n in life.pending.items() if k in but}

    def _pending(self, statuses: Iterable[m.TaskStatus]) -> list[Sent]:
        there = dict.fromkeys((one.rtpu, one.task) for one in statuses)
        found = [
            Sent(key[1], name, count, key[0])
            for key in there
            if key in self._lives
            for name, count in self._lives[key].pending.items()
        ]
        return sorted(found, key=lambda one: one.signal not in _FIRST)

    def _note(self, status: m.TaskStatus) -> None:
        key = (status.rtpu, status.task)
        life = self._lives.get(key)
        if life is not None and life.is_late(status):
            return
        if life is None or life.is_other(status):
            pending = life.pending if life is not None and life.died else {}
            life = _SeenTask(status.tid, status.now, {}, pending)
            self._lives[key] = life
        life.seen = max(life.seen, status.now)
        for name, count in status.signals.items():
            if (more := count - life.counts.get(name, 0)) > 0:
                life.counts[name] = count
                life.pending[name] = life.pending.get(name, 0) + more
        if not status.tid:
            life.died = status.now or 1


@contextmanager
def wake_on_events(clients: RtpuClients) -> Generator[Event]:
    """Have an event set whenever an RTPU publishes one of its own."""
    news = Event()
    client = clients.client
    with ExitStack() as declared:
        for rtpu in clients.names:
            key = key_expressions.rtpu(client.domain, rtpu, "event")
            declared.callback(_take_back, client.subscribe(key, news.set))
        yield news


def must_be_known(
    signals: Sequence[str],
    tasks: Sequence[str],
    statuses: Sequence[m.TaskStatus],
    model: TaskModel,
    where: str,
) -> None:
    """Refuse tasks and signals that do not exist.

    Raises:
        UnknownTaskError: There is no such task.
        StateError: None of the tasks has such a signal.
    """
    there = {status.task for status in statuses}
    for task in tasks:
        if task not in there:
            model.find(task)
    known = dict.fromkeys(PREDEFINED)
    for status in statuses:
        if not tasks or status.task in tasks:
            known |= dict.fromkeys(status.signals)
    for signal in signals:
        if signal not in known:
            raise StateError(
                f"no task has a signal {signal}",
                where=", ".join(tasks) or where,
                expected="one of " + ", ".join(known),
                remedy=did_you_mean(signal, known)
                or "a module declares its own: NAME = UserSignal(0, ...)",
            )


def _take_back(wake_on_events: rpc.Declared) -> None:
    with suppress(zenoh.ZError):  # the session was closed meanwhile
        wake_on_events.undeclare()
