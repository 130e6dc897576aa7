"""Carries tables between machines, in a thread of the agent and never of a task.

Agents of one subsystem on several machines find each other by liveliness tokens, one
per machine: of the agents that share a table, the one that holds a lock on its file
declares it. News is sent at once, all groups of a moment in one packet, newest first,
and is dropped if a link is slow. Whole states are exchanged by queries: when machines
meet, and before an agent answers a command that has changed its table; after a `write`
only its value is.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import zenoh

from pbonet.errors import SvarError
from pbonet.node.wire import ClockOffsets, round_trip, rtpu_messages
from pbonet.svar import Watch
from pbonet.versions import LAYERS
from pbonet.xm.net import key_expressions, messages as m, run_folder

from .call_once import CallOnce
from .mirrored_table import ANSWER_TIME, UNHEARD, MirroredTable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

log = logging.getLogger("pbonet.node")

T = TypeVar("T")
GLANCE_NS = 20_000_000
"""Nanoseconds between quick checks of a table that is not expected to change; these run
without Python."""
LAST_TIME = 1.0
"""Seconds for the last answers at the end."""
NEVER = 1e9
"""A time on the monotonic clock that is never reached."""
ASKED = 1000
"""Maximum number of messages of others that wait for the carrier; more are refused."""


class TableCarrier:
    """The tables that an agent carries, and the thread that carries them.

    Args:
        session: The agent's session.
        domain: Its domain.
        clocks: The other machines' clocks.
        tell: Called with reports for masters.
        refuses: Returns whether a subsystem's packets from a machine are not used.
        speaks: Returns the version of packets that all other machines understand.
    """

    def __init__(
        self,
        session: zenoh.Session,
        domain: str,
        clocks: ClockOffsets,
        tell: Callable[[rtpu_messages.Note], None] = lambda _: None,
        refuses: Callable[[str, str], bool] = lambda _, __: False,
        *,
        speaks: Callable[[], int] = lambda: LAYERS["table"].newest,
    ) -> None:
        self.session, self.domain, self.tell = session, domain, tell
        self.refuses, self.speaks = refuses, speaks
        self.silence: Callable[[str], float] = lambda _: 0.0
        self.machine = key_expressions.machine(run_folder.machine())
        self._clocks = clocks
        self._carried: dict[str, MirroredTable] = {}
        self._tables: Mapping[str, rtpu_messages.OpenTable] = {}
        """Tables to be carried that the carrier's thread has not taken yet."""
        self._todo: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._watch = Watch()
        self._working = threading.Lock()
        """Held by the thread that uses the tables."""
        self._ends = ThreadPoolExecutor(1, thread_name_prefix="pbonet told")
        """Answers requests that wait for other machines."""
        self._calls = CallOnce()
        self._over = False
        self._thread = threading.Thread(
            target=self._work, name="pbonet mirrors", daemon=True
        )

    def start(self, silence: Callable[[str], float]) -> None:
        """Start to carry the tables given to `carry`.

        Args:
            silence: Returns for how many seconds the machine of an RTPU has not
                answered signs of life; infinite before the first answer.
        """
        self.silence = silence
        self._ends.submit(int)  # starts the thread
        self._thread.start()

    def stop(self) -> None:
        """Close all tables; waiting requests are answered."""
        self.carry({})
        self.do(self._end)
        if self._thread.is_alive():
            self._thread.join()
        for done in self._calls.end():
            self.safely(done)
        with contextlib.suppress(TimeoutError):  # answers that are about to be given
            self._ends.submit(int).result(LAST_TIME)
        self._ends.shutdown(wait=False)

    def do(self, what: Callable[[], object]) -> None:
        """Let the carrier's thread call a function; may be called from any thread."""
        self._todo.put(what)
        self._watch.ring()

    def at_once(self, what: Callable[[], T]) -> T | None:
        """Call a function in this thread; None if it fails or the carrier's is busy."""
        if not self._working.acquire(blocking=False):
            return None
        try:
            return what()
        except Exception:
            log.exception("a value could not be transferred")
            return None
        finally:
            self._working.release()

    def end(self, done: Callable[[], None]) -> None:
        """Let a separate thread call `done`; for use in zenoh's threads.

        A zenoh thread that closes a link also ends the requests over it while it holds
        the lock of the routes: an answer sent from that thread would wait forever.
        """
        with contextlib.suppress(RuntimeError):  # shut down: answers are not sent
            self._ends.submit(self.safely, done)

    def offer(self, what: Callable[[], object]) -> bool:
        """As `do` unless too much waits; return whether it will be called."""
        room = self._todo.qsize() < ASKED
        if room:
            self.do(what)
        return room

    def carry(
        self, tables: Mapping[str, rtpu_messages.OpenTable], *, wait: float = 0.0
    ) -> None:
        """Carry exactly these tables, by subsystem."""
        done = threading.Event()
        self._tables = tables
        self.do(lambda: self._carry(tables))
        self.do(done.set)
        if wait:
            done.wait(wait)

    def spread(
        self,
        subsystem: str,
        done: Callable[[], None],
        *,
        take: bool = False,
        value: str = "",
    ) -> None:
        """Call `done` when the other machines have the subsystem's table.

        After a table's end it is called when the carrier has closed it: the last user
        removes the file, and the client may make another one at once. `done` is called
        in the thread for it, in the carrier's, or at once; at the latest by `stop`: the
        changes remain, and the next agent sends them to the others.

        Args:
            subsystem: The subsystem of the table.
            done: Called once.
            take: Whether this machine must also have processed their states, as after
                opening a table that exists elsewhere.
            value: The variable if only the value of one was set: the other machines are
                sent just that, by this thread. If there is none, the carrier is not
                woken and checks in its next turn.
        """
        carried = self._carried.get(subsystem) if subsystem in self._tables else None
        if carried is not None and carried.alone and not take:
            carried.changed = True
            done()
            if not value:  # the mirror checks at once: lost machines count too
                self.do(partial(setattr, carried, "next", 0.0))
            return

        promised = self._calls.make(done)
        if promised is None:
            done()
            return

        def spread() -> None:
            carried = self._carried.get(subsystem)
            if carried is None:
                promised()
                return
            try:
                carried.spread(promised, take=take)
            except Exception:
                promised()  # the waiting client continues, and finds the fault itself
                raise

        whole = partial(self.do, spread)
        if not (value and carried and carried.send_value(value, promised, whole)):
            whole()

    def call(self, call: rtpu_messages.Called) -> None:
        """Send the table to other machines, with calls of successors there."""

        def spread() -> None:
            carried = self._carried.get(call.subsystem)
            if carried is not None:
                carried.call(call.calls)

        self.do(spread)

    def out_of_sight(self, machine: str) -> None:
        """Drop a machine from all tables; may be called from any thread."""
        self.do(lambda: self._each(lambda one: one.lose(machine)))

    def in_sight(self) -> None:
        """Exchange all tables with a machine that has been heard again."""
        self.do(lambda: self._each(MirroredTable.meet))

    def _each(self, what: Callable[[MirroredTable], None]) -> None:
        for one in list(self._carried.values()):
            self.safely(partial(what, one))

    def report(self, limit: float = ANSWER_TIME) -> list[m.TableNews]:
        """Return what came from other machines; nothing at the time-out."""
        found: list[m.TableNews] = []
        done = threading.Event()

        def check_ends() -> None:
            for subsystem, carried in self._carried.items():
                others = carried.mirror.others if carried.mirror is not None else {}
                lost = carried.incoming.lost
                found.extend(
                    m.TableNews(
                        subsystem=subsystem,
                        host=other.host,
                        commits=other.counts.commits,
                        gaps=other.counts.gaps,
                        refused=other.counts.refused,
                        lost=lost[machine],
                    )
                    for machine, other in others.items()
                )
            done.set()

        self.do(check_ends)
        return found if done.wait(limit) else []

    def late(self, machine: str, sent_ns: int) -> int | None:
        """Return the transmission time of a packet in nanoseconds, by the clocks.

        None if that machine's clock is not known, because it has just appeared.
        """
        now = time.monotonic_ns()
        clock = self._clocks.clock(machine, now)
        return None if clock is None else clock.way(sent_ns, now)

    def measured(self, machine: str, begin_ns: int, end_ns: int, sent_ns: int) -> None:
        """Use an exchange of states as a measurement of that machine's clock."""
        self._clocks.add(machine, round_trip(begin_ns, end_ns, sent_ns))

    def _carry(self, tables: Mapping[str, rtpu_messages.OpenTable]) -> None:
        self._watch.forget()  # it keeps tables open
        for subsystem in self._carried.keys() - tables.keys():
            self._carried.pop(subsystem).close()
        for subsystem, use in tables.items():
            if (carried := self._carried.get(subsystem)) is not None:
                carried.use(use)
                continue
            try:
                self._carried[subsystem] = MirroredTable(self, subsystem, use)
            except SvarError as error:
                log.warning("the table of %s is not transferred: %s", subsystem, error)

    def _end(self) -> None:
        self._over = True

    def _work(self) -> None:
        while not self._over:
            self._sleep()
            with self._working:
                self._turn()

    def _turn(self) -> None:
        """Do what is to be done now."""
        with contextlib.suppress(queue.Empty):
            while True:
                self.safely(self._todo.get_nowait())
        now = time.monotonic()
        for one in list(self._carried.values()):
            if now >= one.next:
                one.next = now + UNHEARD  # unless the turn says otherwise
                self.safely(partial(one.turn, now))

    def _sleep(self) -> None:
        """Sleep until there is something to do."""
        with self._working:
            due = min((one.next for one in self._carried.values()), default=NEVER)
            self._watch.forget()
            for one in self._carried.values():
                one.watch(self._watch)
        if self._watch.sleep(round(due * 1e9), GLANCE_NS):
            for one in self._carried.values():
                one.next = 0.0

    @staticmethod
    def safely(what: Callable[[], object]) -> None:
        """Call a function, and log its exception."""
        try:
            what()
        except Exception:  # a fault of one table must not affect the others
            log.exception("a table could not be transferred")
