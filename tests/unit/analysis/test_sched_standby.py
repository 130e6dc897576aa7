"""Releases off the grid, of fallbacks and behind changes of rate: native, then twin."""

from __future__ import annotations

import pytest
from one_task_rig import DEADLINE, MS, failures, kinds, one_slot

from pbonet.analysis.schedule.events import Event
from pbonet.analysis.schedule.records import Mode

PERIOD = 10 * MS


@pytest.fixture
def standby(monkeypatch, tmp_path):
    """One task, which stands by for another one that dies at 12 ms."""
    with one_slot(monkeypatch, tmp_path) as make:
        one = make()
        one.at(2 * MS, mode=Mode.OFF)
        first = one.table.alloc("r", "first")
        one.table.configure(first, pid=2, period_ns=PERIOD, crit=5)
        one.table.post(first, mode=Mode.ON)
        one.table.follow(one.slot, [first])
        one.at(3 * MS, mode=Mode.STANDS)
        one.table.died(first)
        assert (Event.ENGAGE, 0, 12 * MS) in one.at(12 * MS)
        yield one


def releases(found):
    return [at for event, _, at in found if event is Event.RELEASE]


def begin(one, came, ends):
    """Let the standby's `on` have run at `came`; return its releases up to `ends`."""
    found = releases(one.at(came, mode=Mode.ON, begun=True))
    one.at(came + MS // 2, begun=True, done=True)
    while one.now < ends:
        found += releases(one.until(one.now + PERIOD // 2))
        one.at(one.now + PERIOD // 2, begun=True, done=True)
    return found


@pytest.mark.parametrize("came", [13, 14, 15, 16, 18, 19])
def test_the_first_cycle_is_released_as_soon_as_it_is_on(standby, came) -> None:
    assert begin(standby, came * MS, 45 * MS)[0] == came * MS


@pytest.mark.parametrize("came", [10.5, 13.0, 14.999])
def test_in_the_first_half_of_a_period_it_makes_up_for_the_lost_cycle(
    standby, came
) -> None:
    came = int((came + 10) * MS)
    assert begin(standby, came, 45 * MS)[:3] == [came, 30 * MS, 40 * MS]


@pytest.mark.parametrize("came", [15.0, 17.0, 19.95, 19.999999])
def test_in_the_second_half_it_stands_for_the_next_point_of_the_grid(
    standby, came
) -> None:
    found = begin(standby, int(came * MS), 45 * MS)
    assert found[:3] == [int(came * MS), 30 * MS, 40 * MS]
    assert standby.status().missed == 0


def test_everybody_else_begins_on_the_grid(monkeypatch, tmp_path) -> None:
    with one_slot(monkeypatch, tmp_path) as make:
        one = make()
        assert releases(one.until(35 * MS)) == [10 * MS, 20 * MS, 30 * MS]


def change_rate(one, period):
    one.table.configure(one.slot, pid=1, crit=5, drop=3, period_ns=period * MS)
    return one.at(one.now)


@pytest.mark.parametrize(
    ("periods", "changed", "expected"),
    [
        ((10, 8), 5, [10, 16, 24, 32, 40]),
        ((10, 8), 15, [20, 32, 40]),  # 24 is half a new period behind 20
        ((10, 8), 25, [30, 40, 48]),  # not 32
        ((10, 8), 35, [40, 48, 56]),
        ((8, 10), 12, [16, 30, 40]),  # not 20
        ((10, 20), 5, [10, 40, 60]),  # not 20
        ((10, 20), 15, [20, 40, 60]),
        ((20, 10), 15, [20, 30, 40]),
    ],
)
def test_behind_a_change_of_rate_the_next_point_is_more_than_half_a_period_away(
    monkeypatch, tmp_path, periods, changed, expected
) -> None:
    with one_slot(monkeypatch, tmp_path) as make:
        one = make(period_ns=periods[0] * MS)
        one.until(changed * MS)
        one.at(changed * MS, begun=True, done=True)
        missed = one.status().missed
        found = releases(change_rate(one, periods[1]))
        while one.now < expected[-1] * MS:
            found += releases(one.until(one.now + MS))
            one.at(one.now + MS, begun=True, done=True)
        assert found == [at * MS for at in expected]
        assert one.status().missed == missed


def test_a_cycle_behind_a_change_of_rate_has_its_whole_new_period(
    monkeypatch, tmp_path
) -> None:
    """From 10 to 8 ms at 25 ms: a cycle that begins at 30 ms may last to 38 ms."""
    with one_slot(monkeypatch, tmp_path) as make:
        one = make()
        one.until(25 * MS)
        one.at(25 * MS, begun=True, done=True)
        change_rate(one, 8)
        assert releases(one.until(30 * MS)) == [30 * MS]
        one.at(30 * MS + 1, begun=True)
        assert one.until(38 * MS - 1) == []
        assert failures(one.until(38 * MS)) == [DEADLINE]


def test_a_first_cycle_amid_a_period_has_a_period_to_its_deadline(standby) -> None:
    """Released at 13 ms it may last to 23 ms; the release at 20 ms has no cycle."""
    standby.at(13 * MS, mode=Mode.ON)
    standby.at(13 * MS + 1, begun=True)
    found = standby.until(23 * MS - 1)
    assert failures(found) == []
    assert kinds(found, Event.RELEASE, Event.MISS) == [
        (Event.RELEASE, 0),
        (Event.MISS, 1),
    ]
    assert failures(standby.until(23 * MS)) == [DEADLINE]


@pytest.mark.parametrize("last", [Mode.COMMAND, Mode.ON])
def test_a_fallback_takes_over_from_one_that_died_in_what_no_turn_saw(
    monkeypatch, tmp_path, last
) -> None:
    """It was ON, and served a command or turned ON, since the last turn."""
    with one_slot(monkeypatch, tmp_path) as make:
        one = make()
        one.at(2 * MS, mode=Mode.OFF)
        first = one.table.alloc("r", "first")
        one.table.configure(first, pid=2, period_ns=PERIOD, crit=5)
        one.table.follow(one.slot, [first])
        one.at(3 * MS, mode=Mode.STANDS)
        one.table.post(first, mode=Mode.ON)
        if last is Mode.COMMAND:
            one.until(5 * MS)
            one.table.post(first, mode=last)
        one.table.died(first)
        assert (Event.ENGAGE, 0, 6 * MS) in one.at(6 * MS)
        assert one.table.free(first) is None
        assert one.at(7 * MS, mode=Mode.ON, begun=True)


@pytest.fixture
def unseen(monkeypatch, tmp_path):
    """One task that stands by for another one, of which no turn sees more than OFF."""
    with one_slot(monkeypatch, tmp_path) as make:
        one = make()
        one.at(2 * MS, mode=Mode.OFF)
        one.first = one.table.alloc("r", "first")
        one.table.configure(one.first, pid=2, period_ns=PERIOD, crit=5)
        one.table.follow(one.slot, [one.first])
        one.at(3 * MS, mode=Mode.STANDS)
        yield one


def play(one, steps):
    """Let the original do this between two turns; return the second one's decisions."""
    for step in steps.split():
        if step == "falls":
            one.table.post(one.first, fell=True)
        elif step in {"died", "free"}:
            getattr(one.table, step)(one.first)
        else:
            one.table.post(one.first, mode=Mode[step])  # OFF: `off`, or `clear`
    return one.at(6 * MS)


@pytest.mark.parametrize(
    "steps",
    [
        "ON falls",
        "ON COMMAND falls",
        "ON falls falls",
        "ON falls died",
        "ON falls free",
        "ON falls died free",
        "ON falls OFF ON falls",
        "falls OFF ON falls",
    ],
)
def test_a_fallback_takes_over_from_one_that_fell_in_what_no_turn_saw(
    unseen, steps
) -> None:
    """It was ON and went to ERROR since the last turn: it says itself that it was."""
    assert (Event.ENGAGE, 0, 6 * MS) in play(unseen, steps)


@pytest.mark.parametrize(
    "steps",
    [
        "falls",  # in its `on`: it had not come
        "falls died",
        "ON OFF falls",
        "ON OFF died free",
        "ON falls OFF",  # cleared
        "ON falls OFF falls",  # cleared, and failed in its `on`
        "ON falls OFF died free",
        "ON falls OFF ON",
        "ON falls OFF ON OFF",
    ],
)
def test_nobody_takes_over_from_one_that_was_not_on_when_it_failed(
    unseen, steps
) -> None:
    assert Event.ENGAGE not in [event for event, _, _ in play(unseen, steps)]


def test_an_order_between_two_turns_is_no_fall(unseen) -> None:
    """Turned off in order it fails in its next `on`; the last turn saw it ON."""
    unseen.table.post(unseen.first, mode=Mode.ON)
    unseen.at(5 * MS)
    assert Event.ENGAGE not in [event for event, _, _ in play(unseen, "OFF falls")]
