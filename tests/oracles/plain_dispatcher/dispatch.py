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
- Failures and reserves are watched as `watch` says, behind the releases.
- A task that stands by is engaged, that is, granted its `on`, when one of the tasks
  that it is the fallback of has fallen, or all that hand over to it are off. A fallback
  has its first release at once, as a cycle was lost, and its next one on the first
  point of the grid that is more than half a period away.
- A cycle that has used up its period, and the CPU time of another one since, goes last
  among equally critical ones. One that hangs goes last of all, and holds
  no level.
- Ready tasks are ranked by urgency and hold FIFO levels in that order. Under ``park``
  only the most urgent one is let run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.analysis.schedule.events import Event, turns
from pbonet.analysis.schedule.records import Decision, Kind, Mode
from pbonet.analysis.schedule.urgency import NEVER, urgency

from .inputs import After
from .levels import BACKGROUND, assign_levels
from .slotstate import HUNG, LAST, SlotState, arms, returns
from .watch import Watch, contained, disarm, due, limited, over

if TYPE_CHECKING:
    from collections.abc import Iterable

LEAD_NS = 100_000
"""A task that is armed gets its first release at least this far ahead."""
UNKNOWN = -1
"""A task's level for a new leader: the last one may not have set what it decided."""
NO_WISH = 255
SLOTS = 128
_WORD = (1 << 64) - 1


class Dispatcher:
    """The state of all slots and the rules that change it."""

    def __init__(self, *, park: bool = False) -> None:
        self.park = park
        self.slots: dict[int, SlotState] = {}
        self._freed: dict[int, SlotState] = {}
        self._out: list[Decision] = []
        self._read: set[int] = set()

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
        self._read.clear()
        for record in inputs:
            self._take(now, record)
        for slot in sorted(self.slots):
            state = self.slots[slot]
            when = due(state) if state.armed else 0
            if state.fresh or (when and when <= now):
                self._look(now, slot, state)
            self._stand_by(now, slot, state)
        self._rank()
        instants = [due(s) for s in self.slots.values() if s.armed]
        return self._out, min(filter(None, instants), default=0)

    def _look(self, now: int, slot: int, state: SlotState) -> None:
        if limited(state) != (slot in self._read):
            msg = f"slot {slot}: CPU time read {slot in self._read}, not as it must be"
            raise ValueError(msg)
        Watch(slot, state, now, self._decide).look()

    def _stand_by(self, now: int, slot: int, state: SlotState) -> None:
        """Engage a task that stands by, if it is time."""
        if state.mode is not Mode.STANDS or state.engaged or state.dead:
            return
        whom = [self._state(one) for one in range(SLOTS) if state.after >> one & 1]
        fell = state.after_kind == After.FALLBACK and any(one.fell for one in whom)
        if fell or state.after_kind == After.HANDOVER:
            state.engaged = state.ready = True
            state.rel_ns = now
            state.dl_ns = now + (state.deadline or state.period)
            self._decide(Event.ENGAGE, slot, 0, now, state.dl_ns)

    def _state(self, slot: int) -> SlotState:
        return self.slots.get(slot) or self._freed.get(slot) or SlotState()

    def _decide(
        self, event: Event, slot: int, arg: int = 0, a: int = 0, b: int = 0
    ) -> None:
        self._out.append(Decision(int(event), slot, arg, a, b))

    def _take(self, now: int, record: Decision) -> None:
        event = Event(record.kind)
        if event is Event.LEAD:
            for state in self.slots.values():
                state.level = UNKNOWN
            return
        if event is Event.LIFE:
            self._live(record.slot, record.arg, said=bool(record.a))
            return
        self._change(now, record.slot, self.slots[record.slot], event, record)

    def _live(self, slot: int, life: int, *, said: bool) -> None:
        """Take over that a slot was allocated or freed; `said`: its task had fallen."""
        old = self._state(slot)
        self.slots.pop(slot, None)
        self._freed.pop(slot, None)
        if life & 1:
            self.slots[slot] = SlotState(life=life)
        else:  # freed while it was armed: its task has died, and nobody came to say so
            fell = old.armed or old.fell or said
            self._freed[slot] = SlotState(life=life, fell=fell)

    def _change(
        self, now: int, slot: int, state: SlotState, event: Event, record: Decision
    ) -> None:
        match event:
            case Event.CONFIG:
                _configure(state, record)
            case Event.LIMITS:
                _limit(state, record)
            case Event.DEAD:
                state.dead = True
                state.fell |= state.armed
                disarm(state)
            case Event.MODE:
                self._mode(now, slot, state, record)
            case Event.DONE if record.arg:
                _took(state, record)
            case Event.DONE:
                over(state)
            case Event.BEGUN:
                state.begun |= not record.arg
                state.overrun = record.arg or state.overrun
            case _:
                self._notice(now, slot, state, event, record)

    def _notice(
        self, now: int, slot: int, state: SlotState, event: Event, record: Decision
    ) -> None:
        """Take in what concerns failures and reserves."""
        watch = Watch(slot, state, now, self._decide)
        match event:
            case Event.USED:
                state.clock, state.locked = record.a, bool(record.arg)
                self._read.add(slot)
            case Event.HANDLED:
                watch.handled(record.arg)
            case Event.WISH:
                watch.wish(-1 if record.arg == NO_WISH else record.arg, record.a)
            case Event.EVENT:
                if state.kind == Kind.SYNCHRONOUS:
                    watch.device(record.a, record.arg)
                else:
                    watch.event(record.a, active=bool(record.arg))
            case Event.UNLOCKED:
                watch.unlocked()
            case Event.AFTER:
                low, high = (mask & _WORD for mask in (record.a, record.b))
                state.after_kind, state.after = record.arg, low | high << 64
            case _:
                msg = f"{event.name} is no input"
                raise ValueError(msg)

    def _mode(self, now: int, slot: int, state: SlotState, record: Decision) -> None:
        replaces = state.engaged and state.after_kind == After.FALLBACK
        old, word = state.word, record.arg
        state.word, state.fell = word, bool(record.a)
        if arms(word) != arms(old) or state.mode is Mode.OFF:
            disarm(state)
        if returns(word) != returns(old) or state.mode is not Mode.ON:
            state.level = 0
        idle = state.mode in {Mode.OFF, Mode.STANDS}
        state.fresh = not idle and limited(state)
        if idle or state.armed or state.dead:
            return
        state.armed = True
        if state.kind == Kind.PERIODIC:
            grid = -(-(now + LEAD_NS) // state.period) * state.period
            state.next_ns = now if replaces else grid
            return
        state.ready, state.rel_ns, state.dl_ns = True, now, NEVER
        state.event_ns, state.left, state.mark = now, state.maxc, -1
        if state.kind == Kind.SYNCHRONOUS:
            state.rel_ns = now - state.period  # an event may come at once
            state.next_ns = now + state.deadline if state.deadline else 0
        if state.kind == Kind.DEFERRABLE:
            state.dl_ns = state.next_ns = (now // state.period + 1) * state.period
        self._decide(Event.RELEASE, slot, 0, now, state.dl_ns)

    def _rank(self) -> None:
        ranked = [
            (_order(s), s.rel_ns, slot)
            for slot, s in self.slots.items()
            if s.ready and (s.mode is Mode.ON or s.engaged)
        ]
        ranked.sort()
        order = [slot for _, _, slot in ranked]
        states = [self.slots[slot] for slot in order]
        groups = [_group(state) for state in states]
        held = [state.level for state in states]
        cycles, background = groups.count(0), groups.count(1)
        levels = assign_levels(held[:cycles])
        levels += assign_levels(held[cycles:][:background], *BACKGROUND)
        levels += [0] * (len(states) - len(levels))
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
            state.seq = (state.seq + 1) & 0xFFFFFFFF or 1
            self._decide(Event.WAKE, slot, state.seq)
        elif state.parked:
            state.parked = False
            self._decide(Event.RESUME, slot)


def _group(state: SlotState) -> int:
    """Return 0 for cycles, 1 for background tasks, 2 for cycles that hang."""
    if state.overrun == HUNG:
        return 2
    return int(state.kind == Kind.BACKGROUND)


def _order(state: SlotState) -> tuple[int, int, bool, int]:
    """Return the sort key of a ready task."""
    rank = 0 if state.overrun == HUNG else state.rank
    return (
        _group(state),
        -rank,
        state.overrun >= LAST,
        -urgency(rank, state.dl_ns, state.priority),
    )


def _took(state: SlotState, record: Decision) -> None:
    """Take over that a task has released itself since, the last time at `a`."""
    over(state)
    state.seq += record.arg
    state.ready = state.granted = state.begun = True
    state.rel_ns = record.a
    state.dl_ns = record.a + (state.deadline or state.period)
    state.next_ns = record.a + state.period
    state.late = state.sure = False
    state.fresh = limited(state)
    state.clock = max(state.clock, record.b)
    state.mark = state.clock


def _configure(state: SlotState, record: Decision) -> None:
    state.period, state.deadline = record.a, record.b
    state.crit = record.arg & 0xFF
    state.priority = record.arg >> 8 & 0xFFFF
    state.kind = record.arg >> 24 & 0x7F
    if record.arg >> 31:
        state.level = state.clock = state.mark = 0
    if not state.handling:
        state.rank = contained(state)


def _limit(state: SlotState, record: Decision) -> None:
    """Take the limits, which follow a configuration and complete it."""
    state.minc, state.maxc = record.a, record.b
    state.drop, state.handler = record.arg & 0xFF, record.arg >> 8 & 0xFF
    state.tells = bool(record.arg >> 16 & 1)
    state.safe_at = {kind for kind in range(3) if record.arg >> 17 + kind & 1}
    if not state.handling:
        state.rank = contained(state)


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


def _show(records: list[Decision]) -> str:
    return " ".join(
        f"{Event(r.kind).name}({r.slot};{r.arg},{r.a},{r.b})" for r in records
    )
