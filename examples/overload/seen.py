"""What really happened on a core: from the dispatcher's trace and the tasks' records.

The trace says which tasks were ready at every instant, in which order, and which
releases found a cycle unfinished; it is played through the rules once more, so that a
decision which the rules do not make is found. A record says when a cycle began and
ended, and how much CPU time it took by the kernel's own count. Together they tell who
had the core, and how much of that time no task of ours has got: others were let in, the
dispatcher worked, or the machine stood still.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Self

from msgspec import Struct, field

from pbonet.analysis.schedule.events import Event, turns
from pbonet.analysis.schedule.outcome import Account, Outcome, Segment
from pbonet.analysis.schedule.records import Mode
from pbonet.errors import NodeError
from pbonet.node import rt

# The dispatcher's rules in Python, which the tests of the native ones use.
sys.path.append(str(Path(__file__).resolve().parents[2] / "tests" / "oracles"))
from plain_dispatcher.dispatch import Dispatcher

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pbonet.analysis.schedule.records import Decision, SlotStatus
    from pbonet.log import Cycles

_LOOK = 0.05
"""Seconds between two looks; the trace holds seconds."""


class Cycle(Struct, frozen=True):
    """One cycle, as its record has it; nanoseconds."""

    release_ns: int
    start_ns: int
    end_ns: int
    cpu_ns: int


class Ready(Struct, frozen=True):
    """A task that waits for the core or has it."""

    task: str
    number: int
    """Of its cycle, from 1."""
    deadline_ns: int
    spent: bool
    """It has used up what is reserved for it."""


class Turn(Struct, frozen=True):
    """Which tasks are ready from here on, the most urgent one first."""

    now_ns: int
    ready: tuple[Ready, ...]


class Stretch(Struct):
    """Time in which one cycle was the most urgent one."""

    task: str
    number: int
    begin_ns: int
    end_ns: int
    crit: int


class Busy(Struct):
    """Time in which tasks that go before all others had the core without a break."""

    begin_ns: int
    end_ns: int
    cycles: dict[tuple[str, int], Cycle] = field(
        default_factory=dict[tuple[str, int], Cycle]
    )
    """Those that ran, by task and number."""

    @property
    def lost_ns(self) -> int:
        """How much of it is in no cycle's CPU time."""
        used = sum(cycle.cpu_ns for cycle in self.cycles.values())
        return self.end_ns - self.begin_ns - used


class Watcher:
    """Keeps a core's trace while a job runs on it, in a thread.

    Args:
        core: The core.
    """

    def __init__(self, core: int) -> None:
        self.trace: list[Decision] = []
        self.lost = 0
        self.slots: dict[int, SlotStatus] = {}
        """Name, period, criticality, priority, as they were while all tasks were ON."""
        self._core = core
        self._table: rt.CoreTable | None = None
        self._next = 0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, name="trace", daemon=True)

    def __enter__(self) -> Self:
        """Begin; the core need not have a dispatcher yet."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take what is left."""
        self._end.set()
        self._thread.join()
        if self._table is not None:
            self._take(self._table)
            self._table.close()

    def _work(self) -> None:
        while not self._end.wait(_LOOK):
            if self._table is None:
                with contextlib.suppress(NodeError):
                    self._table = rt.CoreTable(self._core, member=False)
            if self._table is not None:
                self._take(self._table)

    def _take(self, table: rt.CoreTable) -> None:
        found: dict[int, SlotStatus] = {}
        for slot in table.slots():
            with contextlib.suppress(NodeError):  # it was given back just now
                found[slot] = table.snapshot(slot)
        # Those that are left when the first is off are ranked anew.
        whole = all(status.mode is Mode.ON for status in found.values())
        self.slots = self.slots | found if whole else found | self.slots
        self._next, lost, records = table.trace(self._next)
        self.lost += lost
        self.trace += records


class History(Struct):
    """A run of several tasks on one core."""

    turns: list[Turn]
    cycles: dict[str, list[Cycle]]
    """By task, those that ended, in order."""
    releases: list[tuple[str, int]]
    """Task and instant."""
    misses: list[tuple[str, int]]
    """Task and deadline that passed unmet."""
    stretches: list[Stretch] = field(default_factory=list[Stretch])
    """In order of time."""

    def cycle(self, task: str, number: int) -> Cycle | None:
        """Return a cycle; None when the run was over before it."""
        cycles = self.cycles.get(task, [])
        return cycles[number - 1] if 0 < number <= len(cycles) else None

    def missed(self, task: str, begin_ns: int, end_ns: int) -> list[int]:
        """Return the deadlines after `begin_ns`, up to `end_ns`, that were not met."""
        return [
            at for name, at in self.misses if name == task and begin_ns < at <= end_ns
        ]

    def released(self, task: str, begin_ns: int, end_ns: int) -> list[int]:
        """Return the releases from `begin_ns` up to `end_ns`."""
        return [
            at
            for name, at in self.releases
            if name == task and begin_ns <= at <= end_ns
        ]

    def granted(self) -> dict[tuple[str, int], int]:
        """Return how long each cycle was the most urgent one, by task and number."""
        total: dict[tuple[str, int], int] = defaultdict(int)
        for one in self.stretches:
            total[one.task, one.number] += one.end_ns - one.begin_ns
        return total

    def busy(self, tasks: Iterable[str]) -> list[Busy]:
        """Return when some of these tasks had the core without a break.

        They are those that go before all others, so that nobody else may run then.
        """
        wanted, found = set(tasks), list[Busy]()
        for one in self.stretches:
            if one.task not in wanted:
                continue
            if not found or one.begin_ns > found[-1].end_ns:
                found.append(Busy(one.begin_ns, one.end_ns))
            found[-1].end_ns = one.end_ns
            cycle = self.cycle(one.task, one.number)
            if cycle is not None:
                found[-1].cycles[one.task, one.number] = cycle
        return found

    def outcome(
        self, tasks: Mapping[str, SlotStatus], begin_ns: int, end_ns: int
    ) -> Outcome:
        """Return a part of it as the simulator returns its schedules, begun at 0."""
        segments = [
            Segment(
                one.task,
                max(one.begin_ns, begin_ns) - begin_ns,
                min(one.end_ns, end_ns) - begin_ns,
                one.crit,
            )
            for one in self.stretches
            if one.task in tasks and one.begin_ns < end_ns and one.end_ns > begin_ns
        ]
        return Outcome(
            start_ns=0,
            end_ns=end_ns - begin_ns,
            segments=segments,
            tasks={
                name: self._account(status, name, begin_ns, end_ns)
                for name, status in tasks.items()
            },
        )

    def _account(
        self, status: SlotStatus, name: str, begin_ns: int, end_ns: int
    ) -> Account:
        missed = [at - begin_ns for at in self.missed(name, begin_ns, end_ns)]
        cycles = self.cycles.get(name, [])
        ended = [one for one in cycles if begin_ns <= one.release_ns < end_ns]
        return Account(
            name=name,
            crit=status.crit,
            period_ns=status.period_ns,
            deadline_ns=status.period_ns,
            releases=len(releases := self.released(name, begin_ns, end_ns)),
            cycles=len(ended),
            missed=len(missed),
            cpu_ns=sum(one.cpu_ns for one in ended),
            first_miss_ns=missed[0] if missed else -1,
            misses_ns=missed,
            releases_ns=[at - begin_ns for at in releases],
            responses_ns=[one.end_ns - one.release_ns for one in ended],
        )


def cycles_of(recording: Cycles) -> dict[str, list[Cycle]]:
    """Return the cycles of every task of a recording."""
    found: dict[str, list[Cycle]] = {}
    for task in recording.tasks:
        arrays = recording.arrays(task)
        columns = [
            arrays[name].tolist()
            for name in ("release_ns", "start_ns", "end_ns", "cpu_ns")
        ]
        found[task] = [Cycle(*row) for row in zip(*columns, strict=True)]
    return found


def history(
    trace: Sequence[Decision],
    names: Mapping[int, str],
    cycles: dict[str, list[Cycle]],
) -> History:
    """Play a trace through the rules and return what happened.

    Args:
        trace: From the core table's begin on.
        names: The tasks by slot.
        cycles: Every cycle of each task, none missing.

    Raises:
        ValueError: The dispatcher decided what its rules do not say.
    """
    twin = Dispatcher()
    found = History([], cycles, [], [])
    crits: list[dict[str, int]] = []
    for head, inputs, decisions in turns(trace):
        twin.park = bool(head.arg)
        own = _own_releases(found, twin, names, inputs)
        found.turns += [turn for turn, _ in own]
        crits += [crit for _, crit in own]
        if twin.turn(head.a, inputs) != (decisions, head.b):
            msg = f"turn at {head.a} ns: the rules do not decide so"
            raise ValueError(msg)
        _note(found, twin, names, [*inputs, *decisions])
        ready = sorted(
            (
                (state.level, slot)
                for slot, state in twin.slots.items()
                if state.ready and state.mode is Mode.ON
            ),
            reverse=True,
        )
        states = [(names.get(slot, ""), twin.slots[slot]) for _, slot in ready]
        found.turns.append(
            Turn(
                head.a,
                tuple(Ready(name, s.seq, s.dl_ns, s.spent) for name, s in states),
            )
        )
        crits.append({name: state.rank for name, state in states})
    _share_out(found, crits)
    return found


def _own_releases(
    found: History,
    twin: Dispatcher,
    names: Mapping[int, str],
    inputs: Sequence[Decision],
) -> list[tuple[Turn, dict[str, int]]]:
    """Return what was ready at the releases that tasks took themselves since a turn.

    Each was the sole ready one then: the cycle before it had ended.
    """
    alone: list[tuple[int, Ready, int]] = []
    for record in inputs:
        if record.kind == Event.DONE and record.arg:
            state = twin.slots[record.slot]
            name = names.get(record.slot, "")
            for taken in range(1, record.arg + 1):
                at = record.a - (record.arg - taken) * state.period
                number = state.seq + taken
                ready = Ready(name, number, at + state.period, spent=False)
                alone.append((at, ready, state.rank))
    before = found.turns[-1].ready if found.turns else ()
    made: list[tuple[Turn, dict[str, int]]] = []
    for at, ready, crit in sorted(alone, key=lambda one: one[0]):
        ends = [found.cycle(one.task, one.number) for one in before]
        begin = max([at, *(one.end_ns for one in ends if one is not None)])
        made.append((Turn(begin, (ready,)), {ready.task: crit}))
        before = (ready,)
    return made


def _note(
    found: History,
    twin: Dispatcher,
    names: Mapping[int, str],
    records: Sequence[Decision],
) -> None:
    """Note releases and the deadlines that were not met by then.

    Tasks take releases themselves, too; a turn learns of them by an input.
    """
    release = 0
    for record in records:
        name = names.get(record.slot, "")
        if record.kind == Event.RELEASE:
            release = record.a
            found.releases.append((name, release))
        elif record.kind == Event.DONE:
            period = twin.slots[record.slot].period
            found.releases += [
                (name, record.a - back * period) for back in reversed(range(record.arg))
            ]
        elif record.kind == Event.MISS:
            period = twin.slots[record.slot].period
            found.misses += [
                (name, release - back * period) for back in reversed(range(record.arg))
            ]


def _share_out(found: History, crits: Sequence[Mapping[str, int]]) -> None:
    """Give the time between two turns to the most urgent ones, until they end."""
    for place, (turn, crit) in enumerate(zip(found.turns, crits, strict=True)):
        now = turn.now_ns
        last = place + 1 == len(found.turns)
        until = now if last else found.turns[place + 1].now_ns
        for one in turn.ready:
            cycle = found.cycle(one.task, one.number)
            end = until if cycle is None else min(cycle.end_ns, until)
            if end > now:
                _append(found.stretches, one, now, end, crit[one.task])
                now = end


def _append(
    stretches: list[Stretch], one: Ready, begin: int, end: int, crit: int
) -> None:
    before = stretches[-1] if stretches else None
    if (
        before is not None
        and (before.task, before.number, before.end_ns, before.crit)
        == (one.task, one.number, begin, crit)
    ):  # fmt: skip
        before.end_ns = end
    else:
        stretches.append(Stretch(one.task, one.number, begin, end, crit))
