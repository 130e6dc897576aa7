"""One task on the native dispatcher in virtual time, its twin looking on."""

from __future__ import annotations

from contextlib import contextmanager

from plain_dispatcher.dispatch import replay

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Mode
from pbonet.node.rt import _rt

US, MS = 1_000, 1_000_000
DEADLINE, MAXEXEC, MINEXEC = range(3)
TELL, SAFE = 1 << 8, 1 << 9


class Core:
    """One task in virtual time; releases are at multiples of 10 ms."""

    def __init__(self, **settings) -> None:
        self.table = _rt.CoreTable(1)
        self.slot = self.table.alloc("r", "t")
        settings = {"period_ns": 10 * MS, "crit": 5, "drop": 3} | settings
        self.table.configure(self.slot, pid=1, **settings)
        self.records = []
        self.now = 0
        self.at(1 * MS, mode=Mode.ON)

    def at(self, now: int, *, lead: bool = False, **part) -> list:
        """Let something happen and take a turn; return its decisions.

        Args:
            now: When.
            lead: Whether it is the first turn of a new leader.
            **part: What the task does, as for `CoreTable.post`.
        """
        self.now = now
        self.table.post(self.slot, **part)
        since = self.table.trace()[0]
        self.table.step(now, lead=lead)
        return self._decisions(since)

    def until(self, now: int) -> list:
        """Take all turns that are due up to an instant; return their decisions."""
        found = []
        while True:
            since = self.table.trace()[0]
            due = self.table.step(self.now)
            found += self._decisions(since)
            if not due or due > now:
                return found
            self.now = due

    def _decisions(self, since: int) -> list:
        _, _, records = self.table.trace(since)
        return [
            (Event(record.kind), record.arg, record.a)
            for record in records
            if record.kind >= Event.RELEASE
        ]

    def status(self):
        return self.table.snapshot(self.slot)

    def check_twin(self) -> None:
        replay(self.table.trace()[2])


@contextmanager
def one_slot(monkeypatch, tmp_path):
    """Yield a maker of cores; behind it the twin must have found the same decisions."""
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    cores = []

    def make(**settings) -> Core:
        cores.append(Core(**settings))
        return cores[-1]

    yield make
    for made in cores:
        made.check_twin()
        made.table.close()


def kinds(decisions, *wanted):
    return [(event, arg) for event, arg, _ in decisions if event in wanted]


def failures(decisions):
    return [arg for event, arg, _ in decisions if event is Event.FAIL]
