"""What a task cannot notice about itself: the twin of ``pbonet/node/rt/watch.h``.

Deadlines reached, reserves of CPU time used up, a least time that can no longer be had,
devices that are silent (Stewart 1994, section 6.3), and on these the reserves of soft
tasks and servers (6.4, 6.5). A failure is contained first, by another criticality in
the same turn, and told afterwards.

CPU time passes no faster than time itself. So a reserve is looked at when it could be
used up at the earliest, and then again, but not more often than every `MARGIN_NS`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Kind
from pbonet.analysis.schedule.urgency import NEVER

if TYPE_CHECKING:
    from .slotstate import SlotState

MARGIN_NS = 20_000
TAKEN_NS = 10_000
"""For which a turn keeps a cycle from running, about: its check is so much later."""
HOLD_OFF_NS = 1_000_000
"""How long a critical section holds the loss of criticality off."""
HANDLER_NS = 1_000_000
"""CPU time that a failure handler has at its own priority."""
PIECES = 8
DEADLINE, MAXEXEC, MINEXEC = range(3)
SERVERS = (Kind.DEFERRABLE, Kind.SPORADIC)
CYCLIC = (Kind.PERIODIC, Kind.SYNCHRONOUS)


class Decide(Protocol):
    """Takes a decision."""

    def __call__(
        self, event: Event, slot: int, arg: int = 0, a: int = 0, b: int = 0
    ) -> None:
        """Put it at the end of the turn's record."""


def sooner(a: int, b: int) -> int:
    """Return the earlier of two instants, where 0 is none."""
    return min(a, b) if a and b else a or b


def limited(state: SlotState) -> bool:
    """Return whether anything depends on the task's CPU time."""
    return bool(state.maxc or state.minc or state.handler)


def due(state: SlotState) -> int:
    """Return when to look at an armed slot next; 0 for not before there is news."""
    when = sooner(state.next_ns, state.check_ns)
    waits = state.kind == Kind.PERIODIC and state.ready and not state.late
    if waits and state.dl_ns < state.next_ns:
        when = sooner(when, state.dl_ns)
    return when


def runs(state: SlotState) -> bool:
    """Return whether there is a cycle that failures can be told to."""
    return state.active if state.kind == Kind.SYNCHRONOUS else state.begun


def contained(state: SlotState) -> int:
    """Return the criticality that the task has but for its handler."""
    if state.spent and not state.owed:
        return min(state.drop, state.crit)
    return state.crit


def over(state: SlotState) -> None:
    """Forget the cycle that has ended, and what was watched about it."""
    state.ready = state.granted = state.begun = state.parked = False
    state.skip = state.handling = state.owed = False
    state.overrun = 0
    state.check_ns = 0


def disarm(state: SlotState) -> None:
    """Forget all that belongs to an arming."""
    over(state)
    state.armed = state.spent = state.late = state.sure = False
    state.fresh = state.active = state.engaged = False
    state.pieces.clear()
    state.level = state.next_ns = 0
    state.rank = state.crit


class Watch:
    """Looks after one slot in one turn.

    Args:
        slot: Its number.
        state: Its state, changed in place.
        now: The turn's instant.
        decide: Takes the decisions.
    """

    def __init__(self, slot: int, state: SlotState, now: int, decide: Decide) -> None:
        self.slot = slot
        self.state = state
        self.now = now
        self._decide = decide

    # -- inputs -----------------------------------------------------------------------

    def handled(self, told: int) -> None:
        """The handler has ended; with it its priority, if nothing else is told."""
        state = self.state
        if state.handling and told == state.told:
            state.handling = False
            self.set_rank(contained(state))

    def wish(self, crit: int, deadline: int) -> None:
        """Give a handler what it asks for, as far as it is entitled to it."""
        state = self.state
        if crit >= 0:
            state.handling = False
            self.set_rank(min(crit, max(state.handler, state.crit)))
        waits = state.kind == Kind.SYNCHRONOUS and not state.active
        if deadline > 0 and state.kind in CYCLIC and not waits:
            state.dl_ns = deadline
            state.late &= deadline <= self.now  # one that has passed is told once

    def event(self, instant: int, *, active: bool) -> None:
        """Something came to a server, or has been served."""
        state = self.state
        state.event_ns, state.active, state.fresh = instant, active, True
        state.overrun = 0
        if state.kind == Kind.SPORADIC:
            state.dl_ns = instant + state.period

    def device(self, instant: int, heard: int) -> None:
        """A cycle that a device has begun is there, or has ended."""
        state = self.state
        if instant != state.event_ns:
            self._attend(instant)
        state.heard, state.active, state.fresh = heard, bool(heard & 1), True
        if not state.active:
            if state.late and state.deadline:
                state.next_ns = self.now + state.deadline
            state.late = state.spent = state.handling = state.owed = False
            state.overrun = 0
            self.set_rank(state.crit)

    def _attend(self, instant: int) -> None:
        """An event has come: a new cycle, with reserves of its own.

        A device may come early, up to half a period; the deadline is then what it would
        be had the event come in its time.
        """
        state = self.state
        expected = state.rel_ns + state.period
        state.event_ns, state.mark = instant, -1
        state.late = state.sure = state.handling = state.owed = False
        state.overrun = 0
        state.spent = expected - instant > state.period // 2
        if state.spent:
            state.overruns += 1
        else:
            state.rel_ns = max(instant, expected)
        state.dl_ns = state.period + (expected if state.spent else state.rel_ns)
        if state.deadline:
            state.next_ns = instant + state.deadline
        self.set_rank(contained(state))

    def unlocked(self) -> None:
        """The critical section has ended; what a server used in it is charged first."""
        if self.state.kind in SERVERS:
            self.state.fresh = True
        else:
            self.settle_debt()

    def settle_debt(self) -> None:
        """The critical section has ended, or has lasted too long."""
        self.state.owed = False
        if not self.state.handling:
            self.set_rank(contained(self.state))

    # -- the turn ---------------------------------------------------------------------

    def look(self) -> None:
        """Do what is due for the slot, or has become so by news."""
        state = self.state
        state.locked = state.locked and limited(state)  # read with the clock, if at all
        if state.kind in SERVERS:
            self._serve()
        elif state.kind == Kind.SYNCHRONOUS:
            self._listen()
        elif state.kind == Kind.PERIODIC:
            if state.fresh and not state.begun:
                state.mark = state.clock
            if state.next_ns <= self.now:
                self._release()
            if state.ready and not state.late and state.dl_ns <= self.now:
                state.late = True
                self._fail(DEADLINE, reachable=state.begun)
            watched = state.ready and limited(state)
            state.check_ns = self._reserves() if watched else 0
        state.fresh = False

    def set_rank(self, rank: int) -> None:
        """Give the task another criticality."""
        if self.state.rank != rank:
            self.state.rank = rank
            self._decide(Event.CRIT, self.slot, rank)

    def _fail(self, kind: int, *, reachable: bool) -> None:
        state = self.state
        tell = state.tells and reachable
        safe = kind in state.safe_at and runs(state)
        state.failures[kind] += 1
        arg = kind | tell << 8 | safe << 9
        self._decide(Event.FAIL, self.slot, arg, self.now)
        if not tell:
            return
        state.told += 1
        if state.handler > state.rank:
            state.handling = True
            state.handler_mark = state.clock
            self.set_rank(state.handler)

    def _release(self) -> None:
        """Grant the newest release that is due; the others are missed."""
        state, now = self.state, self.now
        period, release, missed = state.period, state.next_ns, 0
        last = now // period * period
        if last > release:
            missed = last // period - release // period
            release = last
        length = state.deadline or period
        own = state.rel_ns + length
        in_time = state.ready and own > now  # it was released off the grid
        unmet = state.ready and not state.late and not in_time
        if state.begun and not in_time:
            state.failures[DEADLINE] += missed
        missed += state.ready
        state.dl_ns = own if in_time and state.begun else release + length
        state.ready = True
        if not state.begun:
            state.rel_ns = release
        state.missed += missed
        state.next_ns = ((release + period // 2) // period + 1) * period
        self._decide(Event.RELEASE, self.slot, 0, release, state.dl_ns)
        if missed:
            self._decide(Event.MISS, self.slot, missed)
        self._renew()
        if unmet:
            self._fail(DEADLINE, reachable=state.begun)

    def _renew(self) -> None:
        """Reserves are whole again, whether the last cycle has ended or not."""
        state = self.state
        state.mark = state.clock
        state.spent = state.late = state.sure = False
        if not state.begun:
            state.skip = False
        if state.owed:
            self.settle_debt()
        if not state.handling:
            self.set_rank(state.crit)

    def _later(self, ns: int) -> int:
        return self.now + max(ns, MARGIN_NS)

    def _reserves(self) -> int:
        """Look at the reserves of a cycle; return when to look again."""
        state = self.state
        used = state.clock - state.mark if runs(state) else 0
        following = 0
        if state.maxc and not state.spent:
            if used >= state.maxc:
                self._exhaust()
            else:
                following = self._later(state.maxc - used + TAKEN_NS)
        if state.owed:
            following = sooner(following, self._overrule())
        if state.handling:
            following = sooner(following, self._bound_handler())
        if state.minc and not state.sure:
            following = sooner(following, self._least(state.minc - used))
        return following if state.ready else 0

    def _exhaust(self) -> None:
        """The reserve is used up; in a critical section the drop waits."""
        state = self.state
        state.spent = True
        state.overruns += 1
        if state.locked:
            state.owed, state.locked_ns = True, self.now + HOLD_OFF_NS
        elif not state.handling:
            self.set_rank(contained(state))
        if state.kind in CYCLIC:
            self._fail(MAXEXEC, reachable=runs(state))

    def _overrule(self) -> int:
        state = self.state
        if state.locked_ns > self.now:
            return state.locked_ns
        state.held_off += 1
        self.settle_debt()
        periodic = state.kind == Kind.PERIODIC
        self._decide(Event.FORCE, self.slot, state.seq if periodic else state.heard)
        return 0

    def _bound_handler(self) -> int:
        state = self.state
        left = HANDLER_NS - (state.clock - state.handler_mark)
        if left > 0:
            return self._later(left)
        state.handling = False
        self.set_rank(contained(state))
        return 0

    def _least(self, rest: int) -> int:
        """Look whether MINC can still be had; return when to look again."""
        state = self.state
        if rest <= 0:
            state.sure = True
            return 0
        if self.now + rest <= state.dl_ns:
            return self._later(state.dl_ns - rest + 1 - self.now)
        state.sure = True
        running = runs(state)
        if not running and not state.granted:
            self._fail(MINEXEC, reachable=False)
            over(state)
            state.missed += 1
            self._decide(Event.MISS, self.slot, 1)
            return 0
        if not running:
            state.skip = True
            self._decide(Event.SKIP, self.slot, state.seq)
        self._fail(MINEXEC, reachable=True)
        return 0

    # -- servers and devices ----------------------------------------------------------

    def _serve(self) -> None:
        state = self.state
        self._charge()
        if state.next_ns and state.next_ns <= self.now:
            self._refill()
        if not state.spent and state.left <= 0:
            self._exhaust()
        if state.owed and (not state.locked or state.locked_ns <= self.now):
            state.held_off += state.locked
            self.settle_debt()
        if state.owed:
            state.check_ns = state.locked_ns
        else:
            serving = state.active and not state.spent
            state.check_ns = self._later(state.left) if serving else 0

    def _charge(self) -> None:
        """Take what was used off the capacity; a sporadic server gets it back later.

        What it used at a lower criticality is nobody's; within a critical section it
        keeps its own, and overdraws.

        It is taken to have been used without a break up to now, which is the latest
        that its use can have begun; so nothing comes back too early.
        """
        state = self.state
        used, armed_just_now = state.clock - state.mark, state.mark < 0
        state.mark = state.clock
        if (state.spent and not state.owed) or used <= 0 or armed_just_now:
            return
        state.left -= used
        if state.kind != Kind.SPORADIC:
            return
        at, pieces = self.now - used + state.period, state.pieces
        if pieces and (len(pieces) == PIECES or at - pieces[-1][0] <= 10 * MARGIN_NS):
            pieces[-1] = [max(at, pieces[-1][0]), pieces[-1][1] + used]
        else:
            pieces.append([at, used])
        state.next_ns = pieces[0][0]

    def _refill(self) -> None:
        """Give capacity back that is due; what was overdrawn is kept back."""
        state, before = self.state, self.state.left
        if state.kind == Kind.DEFERRABLE:
            state.left = state.maxc + min(state.left, 0)
            state.next_ns = state.dl_ns = (self.now // state.period + 1) * state.period
        else:
            while state.pieces and state.pieces[0][0] <= self.now:
                state.left += state.pieces.pop(0)[1]
            state.next_ns = state.pieces[0][0] if state.pieces else 0
        self._decide(Event.REFILL, self.slot, 0, state.left - before, state.left)
        if state.left > 0:
            state.spent = False
            if state.owed:
                self.settle_debt()
            self.set_rank(state.crit)

    def _listen(self) -> None:
        """Look after a task with a device; silence is a failure, once in each limit."""
        state, look = self.state, 0
        if state.mark < 0:
            state.mark = state.clock
        if state.next_ns and state.next_ns <= self.now:
            state.next_ns = self.now + state.deadline
            if not state.active:
                state.dl_ns = NEVER
                self._fail(DEADLINE, reachable=True)
        if state.active:
            if state.dl_ns <= self.now:
                self._overtake()
            look = self._reserves() if limited(state) else 0
            look = sooner(look, state.dl_ns)
        elif state.handling:
            look = self._bound_handler()
        state.check_ns = look

    def _overtake(self) -> None:
        """The cycle is past its deadline, and goes on with the next one."""
        state = self.state
        state.dl_ns += ((self.now - state.dl_ns) // state.period + 1) * state.period
        state.late = True
        self._fail(DEADLINE, reachable=True)
