"""When a fallback's cycles are released: native turn, then its twin."""

from __future__ import annotations

import pytest
from oneslot import MS, one_slot

from pbonet.node import _rt
from pbonet.sched.events import Event
from pbonet.sched.records import Mode

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
        one.table.follow(one.slot, _rt.FALLBACK, [first])
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
