"""What tasks tell a program: signals, waited for by name, and events (section 4.4.4).

Every task counts its signals; what a program has not taken yet is *pending*, however
long ago it was sent and however often. So nothing is missed between two waits.
"""

from __future__ import annotations

from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Lock
from typing import TYPE_CHECKING, Protocol

import zenoh
from msgspec import Struct

from pbonet.errors import NoAnswerError, StateError, did_you_mean
from pbonet.pbo import PREDEFINED
from pbonet.xm.net import key_expressions, messages as m, rpc

from . import event_filter
from .argument_text import check_time, names_of
from .change_transaction import Opened
from .event_filter import Choice

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Sequence


LOOK_TIME = 0.5
"""Seconds after which a wait looks at the counts though no event has come."""
LATE_NS = 60_000_000_000
"""A status is late by less than this; an older one is of a machine that was booted
anew, whose clock begins at 0."""
_FIRST = ("SHUTDOWN", "ERROR")
"""Signals that are handed out before others."""


class Sent(Struct, frozen=True):
    """A signal that a task has sent."""

    task: str
    signal: str
    count: int
    """How often it was sent since it was taken last."""
    rtpu: str


class _Life(Struct):
    """What was heard of one task, from its spawn on."""

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
        """Tell whether a status is from before its spawn or, if it died, its death."""
        if self.seen - status.now > LATE_NS:
            return False
        before = bool(self.died and status.tid and status.tid == self.tid)
        return before or status.now < self.since

    def is_other(self, status: m.TaskStatus) -> bool:
        """Tell whether a status is that of a task that was spawned anew."""
        if self.seen - status.now > LATE_NS:
            return True
        if status.tid:
            return bool(self.died) or status.tid != self.tid
        if self.died:
            return status.now != self.died
        return any(status.signals.get(k, 0) < n for k, n in self.counts.items())


class Inbox:
    """Which signals of the tasks are pending: those counted, less those taken.

    It looks at each status that comes, so that a task which dies and is spawned anew
    between two waits takes nothing with it.
    """

    def __init__(self) -> None:
        self._lives: dict[tuple[str, str], _Life] = {}
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
        """Forget what is pending of tasks that were killed."""
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
        """Return what is pending, the most urgent first."""
        with self._busy:
            return self._pending(statuses)

    def take(
        self,
        statuses: Iterable[m.TaskStatus],
        signals: Sequence[str],
        tasks: Sequence[str],
    ) -> Sent | None:
        """Take what is pending first of some signals of some tasks; empty: of all."""
        with self._busy:
            for sent in self._pending(statuses):
                if signals and sent.signal not in signals:
                    continue
                if not tasks or sent.task in tasks:
                    del self._lives[sent.rtpu, sent.task].pending[sent.signal]
                    return sent
        return None

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
            life = _Life(status.tid, status.now, {}, pending)
            self._lives[key] = life
        life.seen = max(life.seen, status.now)
        for name, count in status.signals.items():
            if (more := count - life.counts.get(name, 0)) > 0:
                life.counts[name] = count
                life.pending[name] = life.pending.get(name, 0) + more
        if not status.tid:
            life.died = status.now or 1


class Signalled(Opened, Protocol):
    """The part of `pbonet.master.Subsystem` that hears what its tasks tell."""

    inbox: Inbox

    def sigwait(
        self,
        signal: str | Sequence[str] = (),
        *,
        task: str | Sequence[str] = (),
        timeout: float | None = None,
    ) -> Sent:
        """Wait until a task has sent one of some signals, and take it (`sbsSigWait`).

        A signal that was sent before, and not taken, is returned at once. Others stay
        pending until they are waited for; to be rid of them, mask them.

        Args:
            signal: Names, such as ``FINISH`` or one of the module's own; none: any.
            task: Whose; none: of any task.
            timeout: Seconds; None: as long as it takes.

        Returns:
            The signal, the task that sent it, and how often it did.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: No task has such a signal, or the subsystem was stopped.
            NoAnswerError: The time is over.
        """
        check_time(timeout)
        signals, tasks = names_of(signal), names_of(task)
        self.stopped.clear()
        deadline = None if timeout is None else self.clock.now() + timeout
        with self.news() as news:
            statuses = self._statuses()
            self._must_be_known(signals, tasks, statuses)
            while True:
                if sent := self.inbox.take(statuses, signals, tasks):
                    return sent
                left = LOOK_TIME if deadline is None else deadline - self.clock.now()
                if left <= 0:
                    raise self._too_late(signals, tasks, timeout or 0.0)
                self.clock.wait(min(left, LOOK_TIME), news)
                news.clear()
                self._must_go_on()
                statuses = self._statuses()

    def signals(self) -> list[Sent]:
        """Return the signals that are pending, and leave them so."""
        return self.inbox.pending(self._statuses())

    def sigmask(
        self, signal: str | Sequence[str] | None = None, task: str | None = None
    ) -> dict[str, list[str]]:
        """Say which signals nobody wants; masked ones are not even counted.

        A task without a mask of its own obeys that of the subsystem.

        Args:
            signal: Names; ``none`` is a mask that lets all through, ``unset`` takes the
                mask away. None: only ask.
            task: Whose mask; None: the subsystem's.

        Returns:
            The masks that are set, by task; ``""`` is the subsystem's.

        Raises:
            UnknownTaskError: There is no such task.
            StateError: No task has such a signal.
            ClaimError: It is open for watching only.
        """
        signals = None if signal is None else names_of(signal)
        tasks = [] if task is None else [task]
        names = [] if signals in (["none"], ["unset"]) else list(signals or ())
        if signals is not None:
            self.fleet.must_be_claimed()
        self._must_be_known(names, tasks, self._statuses())
        request = m.Sigmask(
            task=task or "",
            names=None if signals is None else names,
            unset=signals == ["unset"],
        )
        if task is not None and signals is not None:
            self.fleet.call(self.crew.locate(task), request, dict[str, list[str]])
            request = m.Sigmask()
        found, errors = self.fleet.each(lambda _: request, dict[str, list[str]])
        rpc.raise_all(f"{len(errors)} RTPUs do not take a signal mask", errors)
        return {key: mask for masks in found.values() for key, mask in masks.items()}

    def events(
        self,
        last: int | None = None,
        *,
        since: int | str = 0,
        task: str | None = None,
        code: str | None = None,
        severity: str | None = None,
    ) -> list[m.Event]:
        """Return events of the RTPUs that concern the subsystem, the oldest first.

        Args:
            last: At most so many, the newest; None: all that the RTPUs remember.
            since: Number of the first event wanted of each RTPU, or how long ago it
                may have been, such as ``5m``.
            task: Of one task.
            code: Of one code, such as ``WARNING``.
            severity: The least: ``debug`` to ``fatal``.

        Raises:
            StateError: There is no such severity, or `since` says not since when.
        """
        given = {"task": task, "code": code, "severity": severity, "since": since}
        wanted, first = Choice.of(given), event_filter.since(since)[0]
        request = m.Events
        results, errors = self.fleet.each(lambda _: request(since=first), list[m.Event])
        rpc.raise_all(f"{len(errors)} RTPUs do not tell their events", errors)
        found = [event for events in results.values() for event in events]
        if doubt := wanted.doubt(found):
            self._warn(doubt)
        mine = [event for event in found if event.subsystem in {"", self.name}]
        chosen = sorted(filter(wanted, mine), key=lambda event: (event.wall, event.n))
        return chosen if last is None else chosen[max(0, len(chosen) - last) :]

    # -- how --------------------------------------------------------------------------

    def _statuses(self) -> list[m.TaskStatus]:
        return [task for rtpu in self.crew.refresh(strict=False) for task in rtpu.tasks]

    @contextmanager
    def news(self) -> Generator[Event]:
        """Have an event set whenever an RTPU tells something."""
        news = Event()
        client = self.fleet.client
        with ExitStack() as heard:
            for rtpu in self.fleet.names:
                key = key_expressions.rtpu(client.domain, rtpu, "event")
                heard.callback(_take_back, client.hear(key, news.set))
            yield news

    def _must_go_on(self) -> None:
        if self.stopped.is_set():
            raise StateError(
                "the subsystem was stopped while a signal was waited for",
                where=self.name,
                remedy="start it, then wait again",
            )

    def _must_be_known(
        self,
        signals: Sequence[str],
        tasks: Sequence[str],
        statuses: Sequence[m.TaskStatus],
    ) -> None:
        """Refuse tasks and signals that there are not."""
        there = {status.task for status in statuses}
        for task in tasks:
            if task not in there:
                self.crew.picture.find(task)
        known = dict.fromkeys(PREDEFINED)
        for status in statuses:
            if not tasks or status.task in tasks:
                known |= dict.fromkeys(status.signals)
        for signal in signals:
            if signal not in known:
                raise StateError(
                    f"no task has a signal {signal}",
                    where=", ".join(tasks) or self.name,
                    expected="one of " + ", ".join(known),
                    remedy=did_you_mean(signal, known)
                    or "a module declares its own: NAME = UserSignal(0, ...)",
                )

    def _too_late(
        self, signals: Sequence[str], tasks: Sequence[str], timeout: float
    ) -> NoAnswerError:
        others = self.signals()
        return NoAnswerError(
            f"no signal {' or '.join(signals) or 'at all'} within {timeout:g} s",
            where=", ".join(tasks) or self.name,
            got="pending: "
            + (", ".join(f"{one.task} {one.signal}" for one in others) or "nothing"),
            remedy="'status' shows how the tasks stand",
        )


def _take_back(heard: rpc.Declared) -> None:
    with suppress(zenoh.ZError):  # the session was closed meanwhile
        heard.undeclare()
