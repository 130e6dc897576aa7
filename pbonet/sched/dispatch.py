"""The dispatcher's turn as a pure function of its state: the twin of ``dispatch.h``.

A turn takes what happened since the last one (*inputs*) and the time, and answers with
*decisions* and the instant of the next event. Inputs and decisions are `Decision`
records; the native dispatcher writes the same ones into its trace, inputs first. So a
recorded run can be played through this file, and every decision must be found again.

The rules (`docs/realtime.md` gives the reasons):

- Releases lie on the absolute grid of multiples of the period, so that equal periods
  coincide and the user priority orders them.
- A release that finds its task's last cycle unfinished is missed, and the unfinished
  cycle goes on with the deadline of the period that it now uses up (Stewart 1994,
  Listing 2). If that cycle had not even begun, it is the one that is missed.
- However late a turn comes, only the newest release is granted; the others are missed.
- Ready tasks are ranked by urgency and hold FIFO levels in that order. Under ``park``
  only the most urgent one is let run.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

from msgspec import Struct

from .records import Decision, Kind, Mode
from .urgency import NEVER, assign_levels, urgency

if TYPE_CHECKING:
    from collections.abc import Iterable

LEAD_NS = 100_000
"""A task that is armed gets its first release at least this far ahead."""


class Event(IntEnum):
    """What a record of the trace says; ``a``, ``b`` and ``arg`` are its arguments."""

    TURN = 1
    """Heads each turn: at instant a; the next event is at b (0: none); arg 1: park."""
    LIFE = 2
    """Input: the slot was allocated (arg odd) or freed (arg even)."""
    CONFIG = 3
    """Input: period a, relative deadline b (0: period), arg packed by `pack`; its bit
    31 tells of another process, which holds no level."""
    DEAD = 4
    """Input: the task's process is gone, or an orphan, which nobody ranks."""
    MODE = 5
    """Input: the task's mode word arg (`Mode`, arming count, return count)."""
    DONE = 6
    """Input: the granted cycle has ended."""
    BEGUN = 7
    """Input: the granted cycle has begun and not ended."""
    LEAD = 8
    """Input: process a leads from now on; no task is known to hold a level."""
    RELEASE = 16
    """Decision: the release at instant a, deadline b."""
    MISS = 17
    """Decision: arg releases have no cycle of their own."""
    LEVEL = 18
    """Decision: give the task FIFO level arg."""
    WAKE = 19
    """Decision: grant cycle number arg to the task and wake it."""
    PARK = 20
    """Decision: hold the task where it is."""
    RESUME = 21
    """Decision: let a held task go on."""


def pack(crit: int, priority: int, kind: int) -> int:
    """Return the arg of a CONFIG record."""
    return crit | priority << 8 | kind << 24


class SlotState(Struct):
    """What the dispatcher knows of one slot."""

    life: int = 0
    period: int = 1_000_000_000
    deadline: int = 0
    crit: int = 0
    priority: int = 0
    kind: int = 0
    word: int = 0
    dead: bool = False
    armed: bool = False
    ready: bool = False
    """A release is waiting for its cycle to end."""
    granted: bool = False
    """The task was told."""
    begun: bool = False
    parked: bool = False
    level: int = 0
    seq: int = 0
    """Number of the last grant."""
    next_ns: int = 0
    rel_ns: int = 0
    dl_ns: int = 0
    missed: int = 0

    @property
    def mode(self) -> Mode:
        """What the task asks for."""
        return Mode(self.word & 3)


def arms(word: int) -> int:
    """Return how often the task was armed, out of its mode word."""
    return word >> 2 & 0x7FFF


def returns(word: int) -> int:
    """Return how often the task came back from a command, out of its mode word."""
    return word >> 17


class Dispatcher:
    """The state of all slots and the rules that change it."""

    def __init__(self, *, park: bool = False) -> None:
        self.park = park
        self.slots: dict[int, SlotState] = {}
        self._out: list[Decision] = []

    def turn(
        self, now: int, inputs: Iterable[Decision] = ()
    ) -> tuple[list[Decision], int]:
        """Take one turn.

        Args:
            now: The instant, nanoseconds.
            inputs: What happened since the last turn, in the order of the slots.

        Returns:
            The decisions in the order in which they are acted on, and the instant of
            the next event (0: none).

        Raises:
            ValueError: A record is not an input.
        """
        self._out = []
        for record in inputs:
            self._take(now, record)
        for slot in sorted(self.slots):
            state = self.slots[slot]
            if state.armed and state.next_ns and state.next_ns <= now:
                self._release(now, slot, state)
        self._rank()
        due = [s.next_ns for s in self.slots.values() if s.armed and s.next_ns]
        return self._out, min(due, default=0)

    def _decide(
        self, event: Event, slot: int, arg: int = 0, a: int = 0, b: int = 0
    ) -> None:
        self._out.append(Decision(int(event), slot, arg, a, b))

    def _take(self, now: int, record: Decision) -> None:
        event = Event(record.kind)
        if event is Event.LEAD:
            for state in self.slots.values():
                state.level = 0
            return
        if event is Event.LIFE:
            self.slots.pop(record.slot, None)
            if record.arg & 1:
                self.slots[record.slot] = SlotState(life=record.arg)
            return
        self._change(now, record.slot, self.slots[record.slot], event, record)

    def _change(
        self, now: int, slot: int, state: SlotState, event: Event, record: Decision
    ) -> None:
        match event:
            case Event.CONFIG:
                state.period, state.deadline = record.a, record.b
                state.crit = record.arg & 0xFF
                state.priority = record.arg >> 8 & 0xFFFF
                state.kind = record.arg >> 24 & 0x7F
                if record.arg >> 31:
                    state.level = 0
            case Event.DEAD:
                state.dead = True
                _disarm(state)
            case Event.MODE:
                self._mode(now, slot, state, record.arg)
            case Event.DONE:
                state.ready = state.granted = state.begun = state.parked = False
            case Event.BEGUN:
                state.begun = True
            case _:
                msg = f"{event.name} is no input"
                raise ValueError(msg)

    def _mode(self, now: int, slot: int, state: SlotState, word: int) -> None:
        old, state.word = state.word, word
        if arms(word) != arms(old) or state.mode is Mode.OFF:
            _disarm(state)
        if returns(word) != returns(old) or state.mode is not Mode.ON:
            state.level = 0
        if state.mode is Mode.OFF or state.armed or state.dead:
            return
        state.armed = True
        if state.kind == Kind.PERIODIC:
            state.next_ns = -(-(now + LEAD_NS) // state.period) * state.period
        else:
            state.ready, state.rel_ns, state.dl_ns = True, now, NEVER
            self._decide(Event.RELEASE, slot, 0, now, NEVER)

    def _release(self, now: int, slot: int, state: SlotState) -> None:
        period, release, missed = state.period, state.next_ns, 0
        last = now // period * period
        if last > release:
            missed = last // period - release // period
            release = last
        deadline = release + (state.deadline or period)
        missed += state.ready
        if not state.begun:
            state.rel_ns = release
        state.ready, state.dl_ns = True, deadline
        state.missed += missed
        state.next_ns = (release // period + 1) * period
        self._decide(Event.RELEASE, slot, 0, release, deadline)
        if missed:
            self._decide(Event.MISS, slot, missed)

    def _rank(self) -> None:
        ranked = [
            (-urgency(s.crit, s.dl_ns, s.priority), s.rel_ns, slot)
            for slot, s in self.slots.items()
            if s.ready and s.mode is Mode.ON
        ]
        ranked.sort()
        order = [slot for _, _, slot in ranked]
        states = [self.slots[slot] for slot in order]
        levels = assign_levels([state.level for state in states])
        for slot, state, level in zip(order, states, levels, strict=True):
            if state.level != level:
                state.level = level
                self._decide(Event.LEVEL, slot, level)
        top = True
        for slot, state in zip(order, states, strict=True):
            if not self.park or state.kind != Kind.PERIODIC:
                self._let_run(slot, state)
            elif top:
                top = False
                self._let_run(slot, state)
            elif state.granted and not state.parked:
                state.parked = True
                self._decide(Event.PARK, slot)

    def _let_run(self, slot: int, state: SlotState) -> None:
        if not state.granted:
            state.granted = True
            state.seq += 1
            self._decide(Event.WAKE, slot, state.seq)
        elif state.parked:
            state.parked = False
            self._decide(Event.RESUME, slot)


def _disarm(state: SlotState) -> None:
    state.armed = state.ready = state.granted = state.begun = state.parked = False
    state.level = state.next_ns = 0


def replay(trace: Iterable[Decision]) -> int:
    """Play a native trace through the rules, from an empty table on.

    Args:
        trace: Records of complete turns, none missing since the table was made.

    Returns:
        How many releases were checked.

    Raises:
        ValueError: A decision or a next event differs; the text shows the turn.
    """
    twin, releases = Dispatcher(), 0
    for head, inputs, decisions in turns(trace):
        twin.park = bool(head.arg)
        got, due = twin.turn(head.a, inputs)
        if got != decisions or due != head.b:
            msg = (
                f"turn at {head.a} ns\ninputs    {_show(inputs)}\n"
                f"native    {_show(decisions)} next {head.b}\n"
                f"twin      {_show(got)} next {due}"
            )
            raise ValueError(msg)
        releases += sum(record.kind == Event.RELEASE for record in decisions)
    return releases


def turns(
    trace: Iterable[Decision],
) -> Iterable[tuple[Decision, list[Decision], list[Decision]]]:
    """Split a trace into turns: the head, the inputs, the decisions."""
    head: Decision | None = None
    inputs: list[Decision] = []
    decisions: list[Decision] = []
    for record in trace:
        if record.kind == Event.TURN:
            if head is not None:
                yield head, inputs, decisions
            head, inputs, decisions = record, [], []
        elif record.kind < Event.RELEASE:
            inputs.append(record)
        else:
            decisions.append(record)
    if head is not None:
        yield head, inputs, decisions


def _show(records: list[Decision]) -> str:
    return " ".join(
        f"{Event(r.kind).name}({r.slot};{r.arg},{r.a},{r.b})" for r in records
    )
