"""Ages of data from machines whose clocks are hours apart, and drift."""

from __future__ import annotations

from hypothesis import given, strategies as st

from pbonet.node.wire import ClockOffsets, RoundTrips, round_trip
from pbonet.node.wire.clock_offsets import DRIFT, MARGIN_NS, MOST, WINDOW_NS

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
NOW = 100 * HOUR
WAYS = st.integers(0, SECOND // 2)


@given(
    st.integers(-50 * HOUR, 50 * HOUR),
    st.lists(st.tuples(WAYS, WAYS), min_size=1, max_size=12),
    st.floats(-DRIFT, DRIFT),
    st.integers(0, HOUR),
    st.integers(0, HOUR),
)
def test_no_data_are_taken_for_newer_than_the_error_allows(
    ahead, trips, drift, silent, way
):
    """Whatever the ways, the drift, and the time since the last round trip."""
    clocks, now = ClockOffsets(), NOW
    for there, back in trips:
        clocks.add("m2", round_trip(now, now + there + back, now + there + ahead))
        now += SECOND
    known = now
    now += silent + way
    sent = now - way + ahead + round((now - way - known) * drift)
    clock = clocks.clock("m2", now)
    assert clock is not None
    found = clock.way(sent, now)
    half = min(there + back for there, back in trips[-8:]) // 2
    windows = round((len(trips) * SECOND) * DRIFT)
    assert found is not None
    assert found >= way - half - windows - 2


def test_a_clock_is_known_while_its_machine_is_not_seen():
    clocks = ClockOffsets()
    assert clocks.clock("m2", NOW) is None
    clocks.add("m2", round_trip(NOW, NOW + 200, NOW + 100 + HOUR))
    later = clocks.clock("m2", NOW + 200 + SECOND)
    assert later.ahead_ns == HOUR + round(SECOND * DRIFT), "older by the drift"
    assert later.way(NOW + HOUR, NOW + 300_000_000) >= 300_000_000
    assert clocks.clock("m3", NOW) is None, "of another machine, or after it booted"


def test_a_clock_that_was_suspended_is_not_as_measured():
    clocks = ClockOffsets()
    clocks.add("m2", round_trip(NOW, NOW + 200, NOW + 100))
    clock = clocks.clock("m2", NOW + 200)
    assert clock.way(NOW + MARGIN_NS, NOW + 200) == 0
    assert clock.way(NOW + SECOND, NOW + 200) is None, "sent after its arrival"


def test_the_shortest_of_the_last_round_trips_counts():
    trips = RoundTrips()
    assert trips.best is None
    for second, length in enumerate([9, 3, 5, 4, 7]):
        at = NOW + second * SECOND
        trips.add(round_trip(at - length * 1_000_000, at, at))
    assert round(trips.best.seconds * 1e3) == 3
    at = NOW + SECOND + WINDOW_NS + 1
    trips.add(round_trip(at - 8_000_000, at, at))
    assert round(trips.best.seconds * 1e3) == 4


def test_only_so_many_machines_are_remembered():
    clocks = ClockOffsets()
    for n in range(MOST + 10):
        clocks.add(f"m{n}", round_trip(NOW, NOW, NOW))
    known = [n for n in range(MOST + 10) if clocks.clock(f"m{n}", NOW) is not None]
    assert known == list(range(10, MOST + 10))
