"""Timing failures, reserves and servers, case by case: native turn, then its twin."""

from __future__ import annotations

import pytest
from one_task_rig import (
    DEADLINE,
    MAXEXEC,
    MINEXEC,
    MS,
    SAFE,
    TELL,
    US,
    failures,
    kinds,
    one_slot,
)

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Kind, Mode


@pytest.fixture
def core(monkeypatch, tmp_path):
    with one_slot(monkeypatch, tmp_path) as make:
        yield make


# -- cycles that do not return -------------------------------------------------------


def test_a_cycle_that_uses_100_ms_beyond_its_period_comes_last_until_it_ends(core):
    one = core()
    one.until(10 * MS)
    one.at(12 * MS, begun=True, cpu_ns=5 * MS)
    one.until(30 * MS)  # the clock is read when the cycle has used up its period
    one.at(40 * MS, cpu_ns=94 * MS)
    assert not one.status().hung
    assert kinds(one.at(50 * MS, cpu_ns=6 * MS), Event.LEVEL) == [(Event.LEVEL, 0)]
    assert one.status().hung
    one.at(55 * MS, done=True)
    assert not one.status().hung
    assert len(kinds(one.until(60 * MS), Event.LEVEL)) == 1, "it has one again"


@pytest.mark.parametrize("hz", [100, 200, 500, 1000])
def test_a_cycle_that_does_not_return_costs_an_equal_task_two_cycles_at_most(core, hz):
    """One core: what may run uses it; a healthy cycle at 500 Hz takes 0.5 ms of it."""
    hangs = core(period_ns=1_000_000_000 // hz)
    table = hangs.table
    healthy = table.alloc("r", "healthy")
    table.configure(healthy, pid=2, period_ns=2 * MS, crit=5)
    table.post(healthy, mode=Mode.ON)
    left = 5
    for now in range(2 * MS, 202 * MS, MS // 10):
        runs = table.turn(now)
        if runs == healthy:
            left -= 1
            table.post(healthy, begun=True, done=not left, cpu_ns=MS // 10)
            left = left or 5
        elif runs == hangs.slot:
            table.post(hangs.slot, begun=True, cpu_ns=MS // 10)
    assert table.snapshot(hangs.slot).hung
    assert table.snapshot(healthy).missed <= 2


def test_a_cycle_that_goes_last_keeps_its_criticality(core) -> None:
    hangs = core()
    table = hangs.table
    below = table.alloc("r", "below")
    table.configure(below, pid=2, period_ns=10 * MS, crit=4)
    table.post(below, mode=Mode.ON)
    hangs.until(10 * MS)
    hangs.at(11 * MS, begun=True)
    hangs.until(20 * MS)
    table.post(hangs.slot, cpu_ns=10 * MS)
    assert table.turn(30 * MS) == hangs.slot
    table.configure(below, crit=5)
    assert table.turn(40 * MS) == below


def test_a_cycle_that_others_delayed_beyond_its_period_keeps_its_place(core) -> None:
    delayed = core()
    table = delayed.table
    delayed.until(10 * MS)
    delayed.at(12 * MS, begun=True, cpu_ns=2 * MS)
    equal = table.alloc("r", "equal")
    table.configure(equal, pid=2, period_ns=20 * MS, crit=5)
    table.post(equal, mode=Mode.ON)
    delayed.until(20 * MS)
    table.post(delayed.slot, cpu_ns=9 * MS)
    assert table.turn(25 * MS) == delayed.slot


def test_a_device_s_cycle_hangs_in_the_same_way(core) -> None:
    one = core(kind=Kind.SYNCHRONOUS)
    one.at(20 * MS, event=20 * MS, cpu_ns=MS)
    one.until(31 * MS)
    one.at(50 * MS, cpu_ns=99 * MS)
    assert not one.status().hung
    assert kinds(one.at(60 * MS, cpu_ns=1 * MS), Event.LEVEL) == [(Event.LEVEL, 0)]
    assert one.status().hung
    assert len(kinds(one.at(61 * MS, event=61 * MS), Event.LEVEL)) == 1
    assert not one.status().hung


WAITING = [
    {"kind": Kind.SYNCHRONOUS, "deadline_ns": 20 * MS},
    {"kind": Kind.SYNCHRONOUS},
    {"kind": Kind.DEFERRABLE, "maxc_ns": 2 * MS},
    {"kind": Kind.SPORADIC, "maxc_ns": 2 * MS},
]


def wait(one, times: int, cpu_ns: int) -> None:
    """Let the task wait for 100 ms, and use CPU time meanwhile, several times."""
    for _ in range(times):
        now = one.now + 100 * MS
        one.until(now - 1)
        one.at(now, cpu_ns=cpu_ns)


@pytest.mark.parametrize("settings", WAITING)
def test_a_wait_that_computes_loses_its_level_until_an_event_comes(core, settings):
    one = core(**settings)
    wait(one, 4, 100 * MS)
    assert one.status().hung
    assert one.status().in_sync
    assert one.status().level == 0
    one.at(one.now + MS, event=one.now + MS)
    assert not one.status().hung
    assert one.status().level > 0


@pytest.mark.parametrize("settings", WAITING)
def test_a_wait_that_computes_goes_after_less_critical_tasks(core, settings) -> None:
    one = core(**settings)
    table = one.table
    below = table.alloc("r", "below")
    table.configure(below, pid=2, period_ns=20 * MS, crit=1)
    table.post(below, mode=Mode.ON)
    wait(one, 1, 100 * MS)
    assert table.snapshot(below).level < one.status().level
    wait(one, 3, 100 * MS)
    assert table.snapshot(below).level > one.status().level


@pytest.mark.parametrize("settings", [*WAITING, {"kind": Kind.BACKGROUND}])
def test_a_wait_that_uses_little_time_keeps_its_level(core, settings) -> None:
    """It looks for its event again and again: 4 % of the core, for six seconds."""
    one = core(**settings)
    wait(one, 60, 4 * MS)
    assert not one.status().hung


def test_a_background_task_may_compute_while_it_waits(core) -> None:
    one = core(kind=Kind.BACKGROUND)
    wait(one, 20, 100 * MS)
    assert not one.status().hung


@pytest.mark.parametrize("settings", WAITING)
def test_what_short_events_use_is_not_the_wait_s(core, settings) -> None:
    one = core(**settings)
    for _ in range(90):  # beyond a second they would be events without end
        one.at(one.now + 7 * MS, event=one.now + 7 * MS)
        one.at(one.now + 3 * MS, event=one.now, cpu_ns=3 * MS)
    assert not one.status().hung


def test_the_time_after_which_a_cycle_hangs_can_be_set(core) -> None:
    one = core(hang_ns=15 * MS)
    one.until(10 * MS)
    one.at(12 * MS, begun=True)
    one.until(20 * MS)
    one.at(30 * MS, cpu_ns=14 * MS)
    assert not one.status().hung
    one.at(40 * MS, cpu_ns=1 * MS)
    assert one.status().hung


def test_a_new_leader_sets_the_level_that_the_last_one_took_from_a_hung_task(core):
    """The last one may have been killed between its decision and the system call."""
    one = core()
    one.until(10 * MS)
    one.at(12 * MS, begun=True)
    one.until(20 * MS)
    one.at(30 * MS, cpu_ns=100 * MS)
    assert one.status().hung
    found = one.at(31 * MS, lead=True)
    assert kinds(found, Event.LEVEL) == [(Event.LEVEL, 0)]


def test_a_task_that_waits_for_the_core_does_not_hang(core) -> None:
    one = core()
    one.until(10 * MS)
    one.at(12 * MS, begun=True, cpu_ns=5 * MS)
    one.until(900 * MS)
    assert not one.status().hung


# -- deadlines -----------------------------------------------------------------------


def test_a_cycle_that_ends_in_time_is_no_failure(core) -> None:
    one = core()
    one.until(10 * MS)
    one.at(12 * MS, begun=True)
    one.at(19 * MS, done=True)
    assert failures(one.until(20 * MS)) == []
    assert one.status().failures == (0, 0, 0)


def test_the_deadline_is_told_once_and_the_cycle_goes_on_with_the_next(core) -> None:
    one = core(tells=True)
    one.until(10 * MS)
    one.at(12 * MS, begun=True)
    found = one.until(20 * MS)
    assert failures(found) == [DEADLINE | TELL]
    assert (Event.MISS, 1) in kinds(found, Event.MISS)
    assert failures(one.until(30 * MS)) == [DEADLINE | TELL]
    assert one.status().failures == (2, 0, 0)


def test_a_deadline_before_the_period_s_end_is_its_own_event(core) -> None:
    one = core(deadline_ns=4 * MS, tells=True)
    one.until(10 * MS)
    one.at(11 * MS, begun=True)
    found = one.until(19 * MS)
    assert [(event, at) for event, _, at in found if event is Event.FAIL] == [
        (Event.FAIL, 14 * MS)
    ]
    assert failures(one.until(20 * MS)) == []  # it was told already


def test_safe_values_are_for_the_failures_of_a_cycle_under_way(core) -> None:
    one = core(tells=False, safe_at=["deadline"], maxc_ns=2 * MS)
    assert failures(one.until(20 * MS)) == [DEADLINE], "it has not begun"
    one.at(21 * MS, begun=True)
    found = one.at(29 * MS, cpu_ns=3 * MS) + one.until(30 * MS)
    assert failures(found) == [MAXEXEC, DEADLINE | SAFE]


def test_a_handler_is_told_of_what_was_made_safe(core) -> None:
    one = core(tells=True, safe_at=["deadline"])
    one.until(10 * MS)
    one.at(12 * MS, begun=True)
    assert failures(one.until(20 * MS)) == [DEADLINE | TELL | SAFE]


def test_a_cycle_that_never_began_is_counted_but_nobody_is_there_to_tell(core) -> None:
    one = core(tells=True)
    one.until(10 * MS)
    assert failures(one.until(20 * MS)) == [DEADLINE]


# -- reserves ------------------------------------------------------------------------


def test_a_used_up_reserve_costs_the_criticality_until_the_next_release(core) -> None:
    one = core(maxc_ns=2 * MS)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    assert one.until(11 * MS) == []
    found = one.at(13 * MS, cpu_ns=2 * MS)
    assert kinds(found, Event.FAIL, Event.CRIT) == [
        (Event.CRIT, 3),
        (Event.FAIL, MAXEXEC),
    ]
    assert one.status().rank == 3
    assert kinds(one.until(20 * MS), Event.CRIT) == [(Event.CRIT, 5)]
    assert one.status().overruns == 1


def test_preemption_is_not_charged(core) -> None:
    one = core(maxc_ns=2 * MS)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    one.at(18 * MS, cpu_ns=2 * MS - 1)  # begun long ago, mostly preempted
    assert one.status().overruns == 0
    assert one.until(18 * MS + 19 * US) == []  # looked at no sooner than the margin
    found = one.at(18 * MS + 20 * US, cpu_ns=1)
    assert failures(found) == [MAXEXEC]


def test_what_a_turn_takes_from_a_cycle_costs_no_further_check(core) -> None:
    one = core(maxc_ns=2 * MS)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    one.now = one.table.step(one.now)  # when the reserve can be used up
    check = one.now + MS + 10 * US
    one.at(one.now, cpu_ns=1 * MS)
    assert one.table.step(one.now) == check
    found = one.at(check, cpu_ns=1 * MS + 5 * US)  # the turn has taken 5
    assert failures(found) == [MAXEXEC]


def test_a_second_period_gets_its_own_reserve(core) -> None:
    """Stewart 1994, section 6.4: the cycle goes on with what the next one had."""
    one = core(maxc_ns=2 * MS)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    one.at(12 * MS + 100 * US, cpu_ns=2 * MS)
    one.until(20 * MS)
    assert one.status().rank == 5
    one.at(21 * MS, cpu_ns=1 * MS)
    assert one.status().rank == 5
    found = one.at(22 * MS + 100 * US, cpu_ns=1 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 3)]


def test_the_drop_is_never_a_rise(core) -> None:
    one = core(maxc_ns=1 * MS, crit=2, drop=3)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    found = one.at(11 * MS + 100 * US, cpu_ns=1 * MS)
    assert kinds(found, Event.CRIT) == []


# -- least times ---------------------------------------------------------------------


def test_a_cycle_that_cannot_have_its_least_time_is_not_begun(core) -> None:
    one = core(minc_ns=3 * MS, tells=True)
    one.until(10 * MS)
    assert one.until(17 * MS) == []
    found = one.until(17 * MS + MS)
    assert kinds(found, Event.SKIP, Event.FAIL) == [
        (Event.SKIP, 1),
        (Event.FAIL, MINEXEC | TELL),
    ]
    assert one.now == 17 * MS + 1
    assert (Event.MISS, 1) in kinds(one.until(20 * MS), Event.MISS)
    assert one.status().missed == 1  # once, though nobody began it


def test_what_was_used_counts_towards_the_least_time(core) -> None:
    one = core(minc_ns=3 * MS, tells=True)
    one.until(10 * MS)
    one.at(11 * MS, begun=True)
    one.at(12 * MS, cpu_ns=2 * MS)
    assert failures(one.until(19 * MS)) == []
    found = one.until(20 * MS - 1)
    assert failures(found) == [MINEXEC | TELL]
    assert one.now == 19 * MS + 1


def test_a_least_time_that_was_had_is_no_more_watched(core) -> None:
    one = core(minc_ns=3 * MS)
    one.until(10 * MS)
    one.at(11 * MS, begun=True)
    one.at(17 * MS + 1, cpu_ns=3 * MS)
    assert failures(one.until(20 * MS - 1)) == []


# -- handlers ------------------------------------------------------------------------


def test_a_handler_has_its_priority_until_it_has_answered(core) -> None:
    one = core(maxc_ns=2 * MS, handler=6, tells=True)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    found = one.at(12 * MS + 100 * US, cpu_ns=2 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 3), (Event.CRIT, 6)]
    found = one.at(12 * MS + 200 * US, handled=True)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 3)]


def test_a_handler_keeps_its_priority_for_a_millisecond_of_cpu_time_only(core) -> None:
    one = core(maxc_ns=2 * MS, handler=6, tells=True)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    one.at(12 * MS + 100 * US, cpu_ns=2 * MS)
    assert one.status().rank == 6
    one.at(13 * MS + 200 * US, cpu_ns=1 * MS)
    assert one.status().rank == 3


def test_a_wish_is_granted_up_to_what_the_task_is_entitled_to(core) -> None:
    one = core(maxc_ns=2 * MS, tells=True)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    one.at(12 * MS + 100 * US, cpu_ns=2 * MS)
    one.at(12 * MS + 200 * US, wish=(9, 15 * MS))
    assert one.status().rank == 5
    assert failures(one.until(15 * MS)) == [DEADLINE | TELL]
    one.until(20 * MS)
    assert one.status().rank == 5


def test_a_deadline_that_a_handler_sets_into_the_past_is_told_once(core) -> None:
    one = core(tells=True, deadline_ns=5 * MS)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    assert failures(one.until(15 * MS)) == [DEADLINE | TELL]
    assert failures(one.at(15 * MS + US, wish=(-1, 12 * MS))) == []
    assert failures(one.until(20 * MS - 1)) == []
    assert failures(one.at(20 * MS - 1, wish=(-1, 24 * MS))) == []
    assert failures(one.until(20 * MS)) == [DEADLINE | TELL]


# -- critical sections ---------------------------------------------------------------


def test_a_critical_section_keeps_its_criticality_to_its_end(core) -> None:
    one = core(maxc_ns=2 * MS)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    found = one.at(12 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    assert kinds(found, Event.CRIT, Event.FAIL) == [(Event.FAIL, MAXEXEC)]
    found = one.at(12 * MS + 500 * US, locked=False)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 3)]


def test_a_critical_section_that_lasts_too_long_is_overruled_and_counted(core) -> None:
    one = core(maxc_ns=2 * MS)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    one.at(12 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    found = one.until(14 * MS)
    assert kinds(found, Event.CRIT, Event.FORCE) == [(Event.CRIT, 3), (Event.FORCE, 1)]
    assert one.now == 13 * MS + 100 * US
    assert one.status().held_off == 1


def test_a_handler_s_higher_priority_is_inherited_within_the_section(core) -> None:
    """Stewart 1994, section 6.3."""
    one = core(maxc_ns=2 * MS, handler=6, tells=True)
    one.until(10 * MS)
    one.at(10 * MS + US, begun=True)
    found = one.at(12 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 6)]


# -- servers -------------------------------------------------------------------------


def test_a_deferrable_server_drops_and_is_whole_again_at_its_period(core) -> None:
    one = core(kind=Kind.DEFERRABLE, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    found = one.at(16 * MS + 100 * US, cpu_ns=2 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 4)]
    one.table.post(one.slot, cpu_ns=2 * MS)  # at criticality 4: taken from nobody
    found = one.until(20 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 6)]
    assert [(event, a) for event, _, a in found if event is Event.REFILL] == [
        (Event.REFILL, 2 * MS)
    ]


def test_a_deferrable_server_keeps_what_nobody_asked_for(core) -> None:
    one = core(kind=Kind.DEFERRABLE, crit=6, drop=4, maxc_ns=2 * MS)
    one.until(19 * MS)
    one.at(19 * MS + MS // 2, event=19 * MS + MS // 2)
    one.at(20 * MS, cpu_ns=MS // 2)
    one.at(22 * MS + 10 * US, cpu_ns=2 * MS)
    assert one.status().rank == 4  # 2.5 ms without a break, then at 4


def test_what_was_overdrawn_is_kept_back(core) -> None:
    one = core(kind=Kind.DEFERRABLE, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    one.at(16 * MS + 100 * US, cpu_ns=2 * MS + 100 * US)
    one.until(20 * MS)
    one.at(21 * MS + 900 * US, cpu_ns=1 * MS + 900 * US)
    assert one.status().rank == 4


def test_a_sporadic_server_gets_each_piece_back_a_period_after_its_begin(core) -> None:
    one = core(kind=Kind.SPORADIC, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    one.at(15 * MS, cpu_ns=1 * MS, event=15 * MS)  # served
    one.at(17 * MS, event=17 * MS)
    found = one.at(18 * MS, cpu_ns=1 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 4)]
    assert one.until(24 * MS - 1) == []
    found = one.until(24 * MS)
    assert [a for event, _, a in found if event is Event.REFILL] == [1 * MS]
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 6)]


def test_time_below_its_criticality_is_not_given_back(core) -> None:
    """`docs/decisions/0093`."""
    one = core(kind=Kind.SPORADIC, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    one.at(16 * MS, cpu_ns=2 * MS)
    one.at(19 * MS, cpu_ns=3 * MS, event=19 * MS)  # the rest, at criticality 4
    found = one.until(40 * MS)
    assert [a for event, _, a in found if event is Event.REFILL] == [2 * MS]


@pytest.mark.parametrize("kind", [Kind.DEFERRABLE, Kind.SPORADIC])
def test_a_server_keeps_its_criticality_to_the_end_of_a_critical_section(
    core, kind
) -> None:
    one = core(kind=kind, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    found = one.at(16 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    assert kinds(found, Event.CRIT) == []
    assert (one.status().rank, one.status().overruns) == (6, 1)
    found = one.at(16 * MS + 500 * US, cpu_ns=400 * US, locked=False)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 4)]
    assert one.status().held_off == 0


@pytest.mark.parametrize("kind", [Kind.DEFERRABLE, Kind.SPORADIC])
def test_a_server_s_section_that_lasts_too_long_is_overruled(core, kind) -> None:
    one = core(kind=kind, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    one.at(16 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    found = one.until(19 * MS)
    assert kinds(found, Event.CRIT) == [(Event.CRIT, 4)]
    assert (one.now, one.status().held_off) == (17 * MS + 100 * US, 1)


def test_what_a_server_uses_in_its_section_it_lacks_in_the_next_period(core) -> None:
    one = core(kind=Kind.DEFERRABLE, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    one.at(16 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    one.at(16 * MS + 500 * US, cpu_ns=400 * US, locked=False)
    one.table.post(one.slot, cpu_ns=3 * MS)  # at criticality 4: taken from nobody
    found = one.until(20 * MS)
    assert [a for event, _, a in found if event is Event.REFILL] == [2 * MS]
    one.at(21 * MS + 700 * US, cpu_ns=1 * MS + 600 * US)
    assert one.status().rank == 4


def test_a_sporadic_server_gets_back_what_it_used_in_its_section(core) -> None:
    one = core(kind=Kind.SPORADIC, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(14 * MS, event=14 * MS)
    one.at(16 * MS + 100 * US, cpu_ns=2 * MS, locked=True)
    one.at(16 * MS + 500 * US, cpu_ns=400 * US, locked=False)
    found = one.until(40 * MS)
    assert sum(a for event, _, a in found if event is Event.REFILL) == 2400 * US


def test_a_section_that_outlasts_the_period_ends_nothing_that_came_back(core) -> None:
    one = core(kind=Kind.DEFERRABLE, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(17 * MS, event=17 * MS)
    one.at(19 * MS + 500 * US, cpu_ns=2 * MS, locked=True)
    one.until(20 * MS)
    found = one.at(20 * MS + 100 * US, locked=False)
    assert kinds(found, Event.CRIT) == []
    assert one.status().rank == 6


@pytest.mark.parametrize("kind", [Kind.DEFERRABLE, Kind.SPORADIC])
def test_events_without_end_cost_the_level_only_while_no_capacity_is_left(
    core, kind
) -> None:
    """It goes and comes back in the turn in which the capacity does."""
    one = core(kind=kind, crit=6, drop=4, maxc_ns=2 * MS)
    one.at(9 * MS, event=9 * MS)
    for _ in range(120):
        for event in (one.now + MS, one.now + MS + US):  # one ends, the next begins
            one.at(event, event=event)
        one.at(one.table.step(one.now), cpu_ns=2 * MS)
        assert (one.status().level == 0) == one.status().flooded
        found = one.at(one.table.step(one.now))
        assert kinds(found, Event.REFILL)
        assert one.status().level > 0
    assert one.status().flooded
