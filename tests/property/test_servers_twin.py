"""Servers under random events: never more than their capacity, only what is theirs."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
from plain_dispatcher.dispatch import Dispatcher
from plain_dispatcher.inputs import pack, pack_limits
from plain_dispatcher.watch import HOLD_OFF_NS

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Decision, Kind, Mode

MS = 1_000_000
PERIOD, CAPACITY = 10 * MS, 2 * MS


class Server:
    """A server on the dispatcher's twin, and a clock that runs as it is told."""

    def __init__(self, kind: Kind) -> None:
        self.twin = Dispatcher()
        self.now = 1_000 * MS
        self.cpu = 0
        self.active = self.locked = False
        self.high: list[tuple[int, int]] = []
        """Stretches at its own criticality: from, to."""
        word = 4 | Mode.ON
        self.turn(
            Decision(Event.LIFE, 0, 1, 0, 0),
            Decision(Event.CONFIG, 0, pack(6, 0, kind), PERIOD, 0),
            Decision(Event.LIMITS, 0, pack_limits(4, 0, tells=False), 0, CAPACITY),
            Decision(Event.MODE, 0, word, 0, 0),
        )

    @property
    def state(self):
        return self.twin.slots[0]

    def turn(self, *inputs: Decision) -> int:
        """Take a turn; the clock is read whenever the dispatcher must read it."""
        used = Decision(Event.USED, 0, int(self.locked), self.cpu, 0)
        news = {Event.MODE, Event.EVENT, Event.UNLOCKED}
        reads = any(one.kind in news for one in inputs)
        state = self.twin.slots.get(0)
        due = state is not None and self._due(state) <= self.now
        _, following = self.twin.turn(
            self.now, [*inputs, used] if reads or due else list(inputs)
        )
        return following

    @staticmethod
    def _due(state) -> int:
        instants = [one for one in (state.next_ns, state.check_ns) if one]
        return min(instants, default=1 << 62)

    def run(self, until: int) -> None:
        """Let the server work until an instant, with every turn that is due."""
        while self.now < until:
            step = min(self._due(self.state), until) - self.now
            if step > 0:
                if self.active:
                    self.cpu += step
                    if self.state.rank == 6:
                        self.high.append((self.now, self.now + step))
                self.now += step
            if self._due(self.state) <= self.now:
                self.turn()

    def serve(self, length: int, *, locked: bool = False) -> None:
        self.active, self.locked = True, locked
        self.turn(Decision(Event.EVENT, 0, 1, self.now, 0))
        self.run(self.now + length)
        self.active = self.locked = False
        if self.state.owed:
            self.turn(Decision(Event.UNLOCKED, 0, 0, 0, 0))
        self.turn(Decision(Event.EVENT, 0, 0, self.now, 0))

    def used(self, start: int, end: int) -> int:
        return sum(max(min(b, end) - max(a, start), 0) for a, b in self.high)


events = st.lists(
    st.tuples(st.integers(0, 15 * MS), st.integers(1, 6 * MS)), min_size=1, max_size=25
)
locked_events = st.lists(
    st.tuples(st.integers(0, 15 * MS), st.integers(1, 6 * MS), st.booleans()),
    min_size=1,
    max_size=25,
)
MARGIN = 20_000
"""The dispatcher sets no timer nearer than that, so that much may be overdrawn."""


@settings(max_examples=150)
@given(st.sampled_from([Kind.DEFERRABLE, Kind.SPORADIC]), locked_events)
def test_capacity_in_hand_and_on_its_way_back_is_the_declared_one(kind, work) -> None:
    server = Server(kind)
    for pause, length, locked in work:
        server.run(server.now + pause)
        server.serve(length, locked=locked)
        state = server.state
        coming = sum(amount for _, amount in state.pieces)
        assert state.left <= CAPACITY
        if kind is Kind.SPORADIC:
            assert state.left + coming == CAPACITY


@settings(max_examples=150)
@given(events)
def test_a_sporadic_server_takes_no_more_than_a_periodic_task_would(work) -> None:
    server = Server(Kind.SPORADIC)
    for pause, length in work:
        server.run(server.now + pause)
        server.serve(length)
    starts = [start for start, _ in server.high]
    for start in starts:
        for periods in (1, 2, 3):
            window = periods * PERIOD
            most = periods * (CAPACITY + MARGIN)
            assert server.used(start, start + window) <= most


@settings(max_examples=150)
@given(locked_events)
def test_a_critical_section_overdraws_by_its_bound_and_no_more(work) -> None:
    server = Server(Kind.SPORADIC)
    for pause, length, locked in work:
        server.run(server.now + pause)
        server.serve(length, locked=locked)
        assert server.state.left >= -(HOLD_OFF_NS + MARGIN)
        assert (server.state.rank == 6) == (server.state.left > 0)


@settings(max_examples=150)
@given(events)
def test_a_deferrable_server_takes_its_capacity_once_in_each_period(work) -> None:
    server = Server(Kind.DEFERRABLE)
    begin = server.now // PERIOD * PERIOD
    for pause, length in work:
        server.run(server.now + pause)
        server.serve(length)
    overdrawn = 0
    for start in range(begin, server.now, PERIOD):
        used = server.used(start, start + PERIOD)
        assert used <= CAPACITY - overdrawn + MARGIN
        overdrawn = max(used + overdrawn - CAPACITY, 0)
