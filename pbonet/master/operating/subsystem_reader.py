"""A thread that reads a subsystem for the live table, and explains what is asked for.

Keys are taken meanwhile, also while a machine that is away lets a request wait.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from pbonet.errors import PbonetError
from pbonet.master import diagnosis
from pbonet.master.subsystem import Subsystem
from pbonet.xm.net import messages as m

from .table_rows import Reading

if TYPE_CHECKING:
    from collections.abc import Callable

    from .table_rows import Row

RETRY: Final = 1.0
"""Seconds between two attempts to reach the subsystem's agents."""


class SubsystemReader:
    """Reads a subsystem until it is closed.

    Args:
        make: Returns the subsystem, which is not open yet.
        every: Seconds between two readings.
    """

    def __init__(self, make: Callable[[], Subsystem], every: float) -> None:
        self._make = make
        self._every = every
        self._ended = threading.Event()
        self._due = threading.Event()
        """Set when something is to be done before the next reading."""
        self._asked: deque[Row] = deque(maxlen=1)
        self.news = threading.Event()
        """Set when there is a new reading or explanation."""
        self.reading: Reading | None = None
        self.count = 0
        """Readings so far."""
        self.explained: tuple[Row | None, str] = None, ""
        """A row that was asked about, and its explanation."""
        self.failure: BaseException | None = None
        """An error of this program that has ended the reading."""
        self._thread = threading.Thread(target=self._run, name="reader", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Read no more."""
        self._ended.set()
        self._due.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def explain(self, row: Row) -> None:
        """Explain a row; `explained` has it after one of the next `news`.

        Of rows that are asked about meanwhile, only the last is explained.
        """
        self._asked.append(row)
        self._due.set()

    def _take(self) -> Row | None:
        """Return the row that is to be explained, once."""
        try:
            return self._asked.pop()
        except IndexError:
            return None

    def _run(self) -> None:
        try:
            self._read_again_and_again()
        except BaseException as error:  # noqa: BLE001 - raised again where it is shown
            self.failure = error
            self.news.set()

    def _read_again_and_again(self) -> None:
        while not self._ended.is_set():
            subsystem = self._make()
            try:
                subsystem.open(once=True)
            except PbonetError as error:
                self._unreached(subsystem, error)
                self._due.wait(RETRY)
                self._due.clear()
                continue
            try:
                self._read(subsystem)
            except PbonetError as error:
                self._unreached(subsystem, error)
            finally:
                subsystem.detach()

    def _unreached(self, subsystem: Subsystem, error: PbonetError) -> None:
        """Tell that no RTPU answers, and why something is as it is if that is asked."""
        before = self.reading.agents if self.reading is not None else {}
        names = [one.name for one in subsystem.sbs.rtpus]
        silent = dict.fromkeys(names, str(error))
        self._publish(Reading(silent=silent, agents=before, complaints=[str(error)]))
        if (row := self._take()) is not None:
            facts = diagnosis.unreached(subsystem, error)
            self._answer(facts, row)

    def _read(self, subsystem: Subsystem) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            if (row := self._take()) is not None:
                self._answer(diagnosis.ask(subsystem, diagnosis.Extent.SCHEDULE), row)
            if time.monotonic() >= due:
                self._publish(self._reading(subsystem))
                due = max(due + self._every, time.monotonic())
            self._due.wait(max(due - time.monotonic(), 0.0))
            self._due.clear()

    def _answer(self, facts: diagnosis.Facts, row: Row) -> None:
        asked = diagnosis.Question(kind=row.kind, name=row.name)
        try:
            text = str(diagnosis.explain(facts, asked))
        except PbonetError as error:
            text = str(error)
        self.explained = row, text
        self.news.set()

    def _publish(self, reading: Reading) -> None:
        self.reading = reading
        self.count += 1
        self.news.set()

    def _reading(self, subsystem: Subsystem) -> Reading:
        """Read the status of all RTPUs, and all values; each once."""
        clients, task_set = subsystem.clients, subsystem.task_set
        rtpus = subsystem.rtpu_status()
        reading = Reading(
            rtpus=rtpus,
            silent={name: str(error) for name, error in task_set.silent.items()},
            inputs={one.name: [*one.task.inputs] for one in subsystem.model},
        )
        known = self.reading.agents if self.reading is not None else {}
        new = [one.rtpu for one in rtpus if one.rtpu not in known]
        told, _ = clients.each(lambda _: m.Hello(), m.AgentInfo, rtpus=new)
        reading.agents = known | told
        if subsystem.sbs.keeper not in task_set.silent:
            try:
                reading.values = subsystem.display()
            except PbonetError as error:  # no master has opened the table
                reading.complaints.append(str(error))
        return reading
