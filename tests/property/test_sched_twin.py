"""The native turn and its Python twin, driven in step through random histories."""

from __future__ import annotations

import itertools
import random

import pytest
from hypothesis import given, settings, strategies as st
from plain_dispatcher.dispatch import replay
from plain_dispatcher.levels import HIGH, LOW, assign_levels

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Kind, Mode
from pbonet.node.rt import _rt

PERIODS = [100_000, 250_000, 333_333, 1_000_000, 1_000_000, 2_000_000, 7_777_777]


@pytest.fixture(autouse=True, scope="module")
def shm(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PBONET_SHM_DIR", str(tmp_path_factory.mktemp("shm")))
        yield


class History:
    """A table in virtual time, and what may happen to it."""

    def __init__(self, seed: int, *, park: bool) -> None:
        self.random = random.Random(seed)
        self.table = _rt.CoreTable(1)
        self.park = park
        self.now = self.random.randrange(10**6, 10**12)
        self.due = 0
        self.slots: list[int] = []
        self.records = []
        self.since = 0

    def __enter__(self):
        return self

    def __exit__(self, *_exc):
        self.table.close()

    def spawn(self) -> None:
        if len(self.slots) == _rt.SLOTS:
            return
        i = self.table.alloc("r", f"t{self.random.random()}")
        self.slots.append(i)
        if self.random.random() < 0.2:
            self.table.configure(i, kind=self.random.choice(list(Kind)))
        self.configure(i)
        self.table.post(i, mode=Mode.ON)

    def configure(self, i: int) -> None:
        pick = self.random
        self.table.configure(
            i,
            pid=pick.randrange(1, 1 << 30),
            period_ns=pick.choice([*PERIODS, pick.randrange(100_000, 10**7)]),
            deadline_ns=pick.choice([0, 0, pick.randrange(1, 10**7)]),
            crit=pick.choice([3, 5, 5, pick.randrange(64)]),
            priority=pick.choice([0, pick.randrange(65536)]),
            minc_ns=pick.choice([0, 0, pick.randrange(3_000_000)]),
            maxc_ns=pick.choice([0, pick.randrange(3_000_000)]),
            drop=pick.choice([0, 3, pick.randrange(64)]),
            handler=pick.choice([0, 0, pick.randrange(64)]),
            tells=pick.random() < 0.5,
            safe_at=[kind for kind in _rt.KINDS if pick.random() < 0.5],
        )

    def live(self, i: int) -> None:
        """Do what a task does amid its cycle, or what a server does."""
        pick = self.random
        self.table.post(
            i,
            cpu_ns=pick.choice([0, 30_000, pick.randrange(3_000_000), 110_000_000]),
            locked=pick.choice([None, None, False, True]),
            handled=pick.random() < 0.2,
            event=pick.choice([None, None, self.now - pick.randrange(1000)]),
            wish=pick.choice([
                None, None, None,
                (pick.randrange(-1, 64), pick.choice([0, self.now + 500_000])),
            ]),
        )  # fmt: skip

    def wait(self, i: int) -> None:
        """Have a task wait for the fall of others, or for calls, of which some come."""
        pick = self.random
        if pick.random() < 0.6:
            others = pick.sample(self.slots, min(len(self.slots), pick.randrange(4)))
            self.table.follow(i, others)
            return
        ticket, callers = pick.randrange(1, 1 << 31), pick.randrange(1, 4)
        life = self.table.expect(i, ticket, callers)
        for caller in range(pick.randrange(callers + 1)):
            self.table.call(i, life, ticket, caller)

    def event(self) -> None:
        pick = self.random
        i = pick.choice(self.slots) if self.slots else None
        what = pick.random()
        if i is None or what < 0.03:
            self.spawn()
        elif what < 0.05:
            self.slots.remove(i)
            self.table.free(i)
        elif what < 0.06:
            self.table.died(i)
        elif what < 0.10:
            self.configure(i)
        elif what < 0.20:
            self.table.post(i, mode=pick.choice(list(Mode)))
        elif what < 0.40:
            self.table.post(i, begun=True)
        elif what < 0.43:
            self.table.post(i, fell=True)
        elif what < 0.47:
            self.wait(i)
        elif what < 0.65:
            self.live(i)
        else:
            self.table.post(i, done=True)

    def turn(self) -> None:
        pick = self.random
        if self.due and pick.random() < 0.7:
            self.now = max(self.now, self.due + pick.choice([0, 0, 300]))
        else:
            self.now += pick.choice([1, 5_000, 80_000, 3_000_000, 60_000_000])
        lead = pick.random() < 0.02
        self.due = self.table.step(self.now, park=self.park, lead=lead)

    def drain(self) -> None:
        self.since, lost, records = self.table.trace(self.since)
        assert not lost
        self.records += records


@pytest.mark.parametrize("park", [False, True])
@pytest.mark.parametrize("crowd", [1, 5, 25, 128])
def test_over_ten_thousand_releases_the_decisions_are_the_same(park, crowd) -> None:
    with History(seed=crowd * 2 + park, park=park) as history:
        releases = 0
        while releases < 10_000:
            while len(history.slots) < crowd:
                history.spawn()
            for _ in range(history.random.randrange(3 + len(history.slots) // 3)):
                history.event()
            history.turn()
            before = len(history.records)
            history.drain()
            releases += sum(
                record.kind == Event.RELEASE for record in history.records[before:]
            )
    assert replay(history.records) == releases
    seen = {Event(record.kind) for record in history.records}
    rare = {Event.PARK, Event.RESUME, Event.FORCE, Event.UNLOCKED}
    assert crowd < 25 or seen | rare >= set(Event)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.booleans(), st.integers(0, 12))
def test_any_history_gives_the_same_decisions(seed, park, crowd) -> None:
    with History(seed, park=park) as history:
        for _ in range(crowd):
            history.spawn()
        for _ in range(60):
            for _ in range(history.random.randrange(6)):
                history.event()
            history.turn()
        history.drain()
    replay(history.records)


def test_a_twin_that_differs_is_found_out() -> None:
    with History(7, park=False) as history:
        for _ in range(4):
            history.spawn()
        for _ in range(20):
            history.turn()
        history.drain()
    at = next(k for k, r in enumerate(history.records) if r.kind == Event.LEVEL)
    bad = history.records[at]
    history.records[at] = type(bad)(bad.kind, bad.slot, bad.arg + 1, bad.a, bad.b)
    with pytest.raises(ValueError, match=r"(?s)turn at .*native .*LEVEL.*twin"):
        replay(history.records)


levels = st.lists(
    st.one_of(st.just(0), st.integers(LOW, HIGH)), min_size=0, max_size=81
)


@given(levels)
def test_levels_fall_strictly_within_their_range(held) -> None:
    got = assign_levels(held)
    assert all(a > b for a, b in itertools.pairwise(got))
    assert all(LOW <= level <= HIGH for level in got)


@given(levels)
def test_assigning_again_changes_nothing(held) -> None:
    got = assign_levels(held)
    assert assign_levels(got) == got


@settings(max_examples=200)
@given(st.lists(st.one_of(st.just(0), st.integers(1, 7)), max_size=6))
def test_no_choice_keeps_more_levels(held) -> None:
    """Against trying every subset, on few levels so that gaps run out."""

    def fits(kept: list[int]) -> bool:
        places = [-1, *kept, len(held)]
        values = [8, *(held[k] for k in kept), 0]
        return all(
            values[k] - values[k + 1] >= places[k + 1] - places[k]
            for k in range(len(places) - 1)
        )

    if len(held) > 7:
        return
    best = max(
        sum(bits >> k & 1 for k in range(len(held)))
        for bits in range(1 << len(held))
        if all(held[k] for k in range(len(held)) if bits >> k & 1)
        and fits([k for k in range(len(held)) if bits >> k & 1])
    )
    got = assign_levels(held, 1, 7)
    assert sum(a == b for a, b in zip(held, got, strict=True)) >= best
