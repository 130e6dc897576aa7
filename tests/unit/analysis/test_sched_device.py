"""Tasks that a device times, case by case: native turn, then its twin."""

from __future__ import annotations

import pytest
from one_task_rig import (
    DEADLINE,
    MAXEXEC,
    MINEXEC,
    MS,
    TELL,
    US,
    failures,
    kinds,
    one_slot,
)

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Kind, Mode


@pytest.fixture
def device(monkeypatch, tmp_path):
    """Return a maker of tasks that a device times every 10 ms."""
    with one_slot(monkeypatch, tmp_path) as make:
        yield lambda **settings: make(
            **{"kind": Kind.SYNCHRONOUS, "deadline_ns": 20 * MS} | settings
        )


def begin(one, now, **part):
    return one.at(now, event=now, **part)


end = begin  # each event is the begin of a cycle, or its end


def test_a_silent_device_is_a_failure_once_in_each_limit(device) -> None:
    one = device(tells=True)
    begin(one, 2 * MS)
    end(one, 3 * MS)
    assert failures(one.until(22 * MS - 1)) == []
    assert failures(one.until(22 * MS)) == [DEADLINE | TELL]
    assert failures(one.until(62 * MS)) == [DEADLINE | TELL, DEADLINE | TELL]
    begin(one, 63 * MS)
    end(one, 64 * MS)
    assert failures(one.until(83 * MS - 1)) == []


def test_a_cycle_past_its_deadline_is_told_and_goes_on_with_the_next(device) -> None:
    one = device(tells=True)
    begin(one, 12 * MS)
    assert failures(one.until(22 * MS - 1)) == []
    assert failures(one.until(22 * MS)) == [DEADLINE | TELL]
    assert failures(one.until(32 * MS)) == [DEADLINE | TELL]
    end(one, 33 * MS)
    assert failures(one.until(53 * MS - 1)) == []  # it worked, it did not wait


def test_a_cycle_that_ends_in_time_is_no_failure(device) -> None:
    one = device(maxc_ns=4 * MS, minc_ns=2 * MS, tells=True)
    for at in range(10, 100, 10):
        begin(one, at * MS)
        end(one, at * MS + 3 * MS, cpu_ns=3 * MS)
    assert one.status().failures == (0, 0, 0)
    assert one.status().overruns == 0


def test_a_used_up_reserve_costs_the_criticality_until_the_cycle_ends(device) -> None:
    one = device(maxc_ns=2 * MS, tells=True)
    begin(one, 10 * MS)
    found = one.at(12 * MS + 100 * US, cpu_ns=2 * MS)
    assert kinds(found, Event.FAIL, Event.CRIT) == [
        (Event.CRIT, 3),
        (Event.FAIL, MAXEXEC | TELL),
    ]
    assert kinds(end(one, 15 * MS), Event.CRIT) == [(Event.CRIT, 5)]
    begin(one, 20 * MS)
    assert one.until(21 * MS) == []
    assert (one.status().rank, one.status().overruns) == (5, 1)


def test_what_the_wait_used_is_not_charged(device) -> None:
    one = device(maxc_ns=2 * MS)
    begin(one, 10 * MS)
    end(one, 11 * MS, cpu_ns=1 * MS)
    begin(one, 20 * MS, cpu_ns=9 * MS)
    one.at(21 * MS, cpu_ns=1 * MS)
    assert one.status().overruns == 0


def test_a_least_time_that_cannot_be_had_is_told(device) -> None:
    one = device(minc_ns=3 * MS, tells=True)
    begin(one, 10 * MS)
    assert failures(one.until(17 * MS)) == []
    assert failures(one.until(18 * MS)) == [MINEXEC | TELL]
    assert one.now == 17 * MS + 1


def test_a_critical_section_is_overruled_for_its_own_cycle_only(device) -> None:
    one = device(maxc_ns=2 * MS)
    begin(one, 10 * MS)
    one.at(12 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    found = one.until(14 * MS)
    assert kinds(found, Event.CRIT, Event.FORCE) == [(Event.CRIT, 3), (Event.FORCE, 1)]
    end(one, 14 * MS, locked=False)
    begin(one, 20 * MS)
    one.at(22 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    assert kinds(one.until(24 * MS), Event.FORCE) == [(Event.FORCE, 3)]


def test_a_handler_has_its_priority_for_a_bounded_time_in_the_wait_too(device) -> None:
    one = device(handler=6, tells=True)
    assert kinds(one.until(21 * MS), Event.CRIT) == [(Event.CRIT, 6)]
    found = one.at(22 * MS + 100 * US, cpu_ns=1 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 5)]


def flood(one, cycles: int, apart: int = 20 * US) -> None:
    """Let events come, each as soon as the cycle of the last one has ended."""
    for _ in range(cycles):
        begin(one, one.now + apart)
        end(one, one.now + apart)


def test_events_without_end_cost_the_level_until_fewer_come(device) -> None:
    one = device()
    flood(one, 90)
    assert one.status().level > 0
    flood(one, 30)
    assert one.status().flooded
    assert one.status().hung
    assert one.status().level == 0
    for _ in range(50):
        begin(one, one.now + 10 * MS)
        end(one, one.now + MS)
    assert not one.status().flooded
    assert not one.status().hung
    assert one.status().level > 0


def test_a_flood_is_over_when_the_device_was_silent(device) -> None:
    one = device()
    flood(one, 120)
    one.until(one.now + 900 * MS)
    begin(one, one.now + MS)
    assert not one.status().flooded
    assert one.status().level > 0


def test_events_that_come_in_pairs_are_no_flood(device) -> None:
    one = device()
    for _ in range(300):
        flood(one, 2, apart=MS // 10)
        one.at(one.now + 16 * MS)
    assert not one.status().flooded


class TestUrgency:
    """Beside a periodic task of 7 ms that is as critical."""

    @pytest.fixture
    def two(self, device):
        one = device()
        other = one.table.alloc("r", "other")
        one.table.configure(other, pid=2, period_ns=7 * MS, crit=5, drop=3)
        one.other = other
        one.table.post(other, mode=Mode.ON)
        one.at(1 * MS + 1)
        return one

    def above(self, two) -> bool:
        levels = (two.status().level, two.table.snapshot(two.other).level)
        return levels[0] > levels[1]

    def test_the_deadline_is_a_period_behind_the_event(self, two) -> None:
        begin(two, 2 * MS)  # until 12 ms
        two.until(7 * MS)  # until 14 ms
        assert self.above(two)
        end(two, 7 * MS + US)
        begin(two, 12 * MS)  # until 22 ms, the other until 21 ms
        two.until(14 * MS)
        assert not self.above(two)

    def test_who_waits_for_the_next_event_in_time_goes_first(self, two) -> None:
        begin(two, 2 * MS)
        end(two, 3 * MS)
        two.until(7 * MS)
        assert self.above(two)

    def test_who_was_silent_goes_last(self, two) -> None:
        two.until(25 * MS)
        assert not self.above(two)

    def test_an_early_event_has_the_deadline_of_one_in_time(self, two) -> None:
        begin(two, 2 * MS)
        end(two, 3 * MS)
        two.until(7 * MS)  # until 14 ms
        begin(two, 8 * MS)  # 4 ms early: until 22 ms
        assert not self.above(two)
        assert two.status().rank == 5


def test_a_device_that_is_much_too_fast_takes_nothing_from_others(device) -> None:
    one = device(maxc_ns=2 * MS)
    begin(one, 10 * MS)
    end(one, 11 * MS)
    found = begin(one, 14 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 3)]
    found = end(one, 14 * MS + 500 * US)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 5)]
    begin(one, 16 * MS)  # 4 ms early
    assert (one.status().rank, one.status().overruns) == (5, 1)


def test_behind_a_cycle_only_silence_is_waited_for(device) -> None:
    one = device(maxc_ns=2 * MS)
    begin(one, 10 * MS)
    assert one.table.step(one.now) == 12 * MS + 10 * US
    end(one, 11 * MS)
    assert one.table.step(one.now) == 30 * MS
