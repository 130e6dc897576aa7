"""Logs of several machines in one time, by what their agents measured."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given, strategies as st
from made_logs import PLAIN, about, group, record, run
from mcap.reader import make_reader

from pbonet.log import Log, LogWriter, clocks, text
from pbonet.log.rewrite import merge
from pbonet.log.time_conversion import Moves

MS = 10**6
EPOCH = 10**18
DATA = group(PLAIN, random.Random(1))[0]


class Host:
    """A machine whose clocks are off.

    Args:
        name: Of its RTPU and its host.
        ahead_ms: Of its CLOCK_MONOTONIC, to true time.
        wall_ms: Of its wall clock.
    """

    def __init__(self, folder, name, ahead_ms=0, wall_ms=0):
        self.name, self.ahead = name, ahead_ms
        epoch = EPOCH + (wall_ms - ahead_ms) * MS
        told = run("r", host=name, machine=f"boot-{name}", epoch_ns=epoch)
        told.rtpu = name
        folder.mkdir(exist_ok=True)
        self.writer = LogWriter(folder / f"{name}.mcap", told)

    def cycles(self, task, times):
        named = about(task, PLAIN)
        named.rtpu = self.name
        number = self.writer.add_task(named)
        for n, at in enumerate(times, 1):
            ns = (at + self.ahead) * MS
            head = {"cycle": n, "release_ns": ns, "start_ns": ns, "end_ns": ns}
            self.writer.add(number, record(DATA, **head))

    def event(self, at, task, state):
        said = {"severity": 20, "text": "", "rtpu": self.name, "code": "STATE"}
        ns = (at + self.ahead) * MS
        self.writer.add_event(said | {"time": ns, "task": task, "state": state})

    def measured(self, other, within_ms=0.5, wrong_ms=0.0, at=0):
        """Put on record how far another clock is ahead, as an agent measures it."""
        offset = round((other.ahead - self.ahead + wrong_ms) * MS)
        one = {"rtpu": other.name, "machine": f"boot-{other.name}"}
        one |= {"offset_ns": offset, "within_ns": round(within_ms * MS)}
        told = {"machine": f"boot-{self.name}", "others": [one]}
        self.writer.add_clocks((at + self.ahead) * MS, told)


@pytest.fixture
def two(tmp_path):
    """Machine b: its clock 7 s ahead, its wall clock 3 s behind; cycles in turns."""
    a, b = Host(tmp_path / "r", "a"), Host(tmp_path / "r", "b", 7000, -3000)
    a.cycles("left", range(100, 200, 10))
    b.cycles("right", range(105, 205, 10))
    b.event(104, "right", "ON")
    b.event(206, "right", "OFF")
    return a, b, tmp_path / "r"


def closed(*hosts):
    for host in hosts:
        host.writer.close()


def releases(log, task):
    return ((log.arrays(task)["release_ns"] - log.begin_ns) // MS).tolist()


def topics(path):
    """Return whose messages stand in a file, one behind the other."""
    with path.open("rb") as file:
        return [c.topic for _, c, _ in make_reader(file).iter_messages()]


def test_a_shifted_stamp_is_moved_by_what_was_measured(two) -> None:
    a, b, folder = two
    a.measured(b, within_ms=0.5)
    closed(a, b)
    log = Log(folder)
    first, second = log.clocks
    assert (first.how, first.shift_ns) == (clocks.SAME, 0)
    assert (second.how, second.shift_ns, second.within_ns) == (
        *(clocks.MEASURED, 3000 * MS),
        MS // 2,
    )
    assert releases(log, "left") == list(range(0, 100, 10))
    assert releases(log, "right") == list(range(5, 105, 10))
    time, _ = log.series("Y")
    assert time[0] == 0.0
    assert [one.time_ns - EPOCH for one in log.messages("json", "/events")] == [
        *(104 * MS, 206 * MS)
    ]
    told = text.info(log)
    assert told["seconds"] == pytest.approx(0.206)
    assert told["tasks"]["right"]["states"] == pytest.approx({"ON": 0.102, "OFF": 0.0})
    line = "b on b: its times are shifted by +3.000000 s, measured within 0.500 ms"
    assert line in text.info_text(told).splitlines()


def test_merged_logs_are_in_order_and_say_by_which_clocks(two, tmp_path) -> None:
    a, b, folder = two
    b.measured(a, within_ms=0.25)  # the other one measured
    closed(a, b)
    out = tmp_path / "one.mcap"
    done = merge([folder], out)
    assert done.messages == 23
    assert done.clocks[1].within_ns == MS // 4
    in_turns = [one for one in topics(out) if one in {"arm/left", "arm/right"}]
    assert in_turns == ["arm/left", "arm/right"] * 10
    one, both = Log(out), Log(folder)
    for task in ("left", "right"):
        assert releases(one, task) == releases(both, task)
        raw = one.lives(task)[0].commits
        assert list(raw) == list(both.lives(task)[0].commits), "to the bit"
        assert one.lives(task)[0].moves == both.lives(task)[0].moves
    assert one.span_ns == both.span_ns
    assert "merged: b on b: its times are shifted by" in text.info_text(text.info(one))
    again = tmp_path / "again.mcap"
    merge([out], again)
    assert releases(Log(again), "right") == releases(both, "right")


def test_a_clock_that_nobody_measured_is_told(two) -> None:
    a, b, folder = two
    closed(a, b)
    log = Log(folder)
    assert log.clocks[1].how == clocks.UNKNOWN
    assert "its clock was not measured" in text.info_text(text.info(log))
    assert (releases(log, "right")[0], releases(log, "left")[0]) == (0, 2995)


def test_the_surest_chain_of_measurements_counts(tmp_path) -> None:
    hosts = [
        Host(tmp_path / "r", name, ahead, wall)
        for name, ahead, wall in (("a", 0, 0), ("b", 500, 90), ("c", -800, 40))
    ]
    a, b, c = hosts
    for host in hosts:
        host.cycles(f"of_{host.name}", [100, 110])
    a.measured(c, within_ms=9.0, wrong_ms=8.0)
    a.measured(b, within_ms=0.5)
    c.measured(b, within_ms=0.25)
    closed(*hosts)
    log = Log(tmp_path / "r")
    assert [one.within_ns / MS for one in log.clocks] == [0, 0.5, 0.75]
    for task in log.tasks:
        assert releases(log, task) == [0, 10]


def test_clocks_that_drift_are_less_sure(two) -> None:
    a, b, folder = two
    for n in range(5):
        a.measured(b, within_ms=0.5, wrong_ms=n)
    closed(a, b)
    clock = Log(folder).clocks[1]
    assert clock.within_ns == 2.5 * MS
    assert clock.shift_ns == (3000 - 2) * MS
    assert not clock.moves.drifts, "at one instant"


PPM = 50
"""How much too fast the clock of machine b goes; 3 ms a minute."""
MINUTES = 20


@pytest.fixture
def drifting(tmp_path):
    """Two machines that see the same instants, by clocks of which one is too fast."""
    a, b = Host(tmp_path / "r", "a"), Host(tmp_path / "r", "b", 7000, -3000)
    each = [60_000 * n for n in range(MINUTES + 1)]
    a.cycles("left", each)
    b.cycles("right", [at * (1 + PPM * 1e-6) for at in each])
    for at in range(0, 60_000 * MINUTES + 1, 5000):
        b.ahead = 7000 + at * PPM * 1e-6
        wrong = 0.2 if at % 2 else -0.2
        a.measured(b, within_ms=0.25, wrong_ms=wrong, at=at)
    closed(a, b)
    return tmp_path / "r"


def test_a_clock_that_drifts_measurably_is_followed(drifting, tmp_path) -> None:
    log = Log(drifting)
    clock = log.clocks[1]
    assert clock.moves.drifts
    assert clock.within_ns < 1.5 * MS, "one value would be wrong by 30 ms"
    left, right = (log.arrays(task)["release_ns"] for task in ("left", "right"))
    assert np.abs(right - left).max() < clock.within_ns
    lines = text.info_text(text.info(log)).splitlines()
    (line,) = [one for one in lines if one.startswith("b on b")]
    assert "shifted by +3.000" in line
    assert "at the beginning and +2.94" in line

    merge([drifting], tmp_path / "one.mcap")
    merge([tmp_path / "one.mcap"], tmp_path / "again.mcap")
    for name in ("one", "again"):
        merged = Log(tmp_path / f"{name}.mcap")
        assert np.array_equal(merged.arrays("right")["release_ns"], right)
        assert merged.lives("right")[0].moves == log.lives("right")[0].moves
        assert merged.span_ns == log.span_ns
    turns = [one for one in topics(tmp_path / "one.mcap") if "clocks" not in one]
    pairs = [set(turns[n : n + 2]) for n in range(0, len(turns), 2)]
    assert pairs == [{"arm/left", "arm/right"}] * (MINUTES + 1)


def test_drift_is_followed_along_a_chain(drifting) -> None:
    c, b = Host(drifting, "c", -800, 40), Host(drifting.parent, "b")
    c.cycles("far", [60_000 * n for n in range(MINUTES + 1)])
    for at in range(0, 60_000 * MINUTES + 1, 5000):
        b.ahead = 7000 + at * PPM * 1e-6
        c.measured(b, within_ms=0.25, at=at)
    closed(b, c)
    log = Log(drifting)
    assert [one.how for one in log.clocks] == ["one clock", "measured", "measured"]
    left, far = (log.arrays(task)["release_ns"] for task in ("left", "far"))
    assert np.abs(far - left).max() < log.clocks[2].within_ns < 3 * MS


def test_a_wall_clock_that_was_set_moves_nothing(tmp_path) -> None:
    """Between two recorders of one machine; its CLOCK_MONOTONIC goes on."""
    before = Host(tmp_path / "r", "a")
    before.cycles("left", [100, 110])
    before.writer.about.part = 1
    before.writer.close()
    told = run("r", host="a", machine="boot-a", epoch_ns=EPOCH + 5000 * MS, part=2)
    told.rtpu = "a"
    after = LogWriter(tmp_path / "r" / "a-2.mcap", told)
    named = about("left", PLAIN)
    named.rtpu = "a"
    number = after.add_task(named)
    after.add(number, record(DATA, cycle=3, release_ns=120 * MS, end_ns=120 * MS))
    after.close()
    log = Log(tmp_path / "r")
    assert [one.shift_ns for one in log.clocks] == [0, -5000 * MS]
    assert log.span_ns == (EPOCH + 100 * MS, EPOCH + 120 * MS)
    assert np.diff(log.arrays("left")["release_ns"]).tolist() == [10 * MS, 10 * MS]
    assert log.begin_time_ns == EPOCH + 100 * MS


def test_a_log_that_went_on_in_another_file_is_one_when_merged(tmp_path) -> None:
    """A task has one life then, and can be verified like in the files."""
    folder = tmp_path / "r"
    folder.mkdir()
    for part in (1, 2, 3):
        name = "run.mcap" if part == 1 else f"run-{part}.mcap"
        told = run("r", part=part, goes_on=part == 2, machine="boot")
        writer = LogWriter(folder / name, told)
        writer.add_event({"time": 0, "severity": 10, "code": "X", "text": ""})
        others = ["other"] * (part == 2)  # so that channels have other numbers
        for task in (*others, "pid"):
            number = writer.add_task(about(task, PLAIN))
            for n in range(10 * part, 10 * part + 5):
                at = n * MS
                writer.add(number, record(DATA, cycle=n, release_ns=at, end_ns=at))
            writer.add(number, record(b"{}", kind=7, end_ns=at))
        writer.close()
    both = Log(folder)
    merge([folder], tmp_path / "one.mcap")
    one = Log(tmp_path / "one.mcap")
    for log in (both, one):
        lives = log.lives("pid")
        assert [len(life.commits) for life in lives] == [10, 5], "it stopped behind 2"
        assert [len(life.steps) for life in lives] == [2, 1]
    assert list(one.lives("pid")[0].records) == list(both.lives("pid")[0].records)


@given(
    points=st.dictionaries(
        st.integers(0, 2**52), st.integers(-(2**51), 2**51), min_size=1
    ),
    begin=st.integers(0, 2**62),
    time=st.integers(-1, 2**52),
    which=st.none() | st.integers(0, 50),
)
def test_a_single_time_is_converted_as_many_are(points, begin, time, which) -> None:
    moves = Moves.through((begin + at, add) for at, add in points.items())
    at = begin + time if which is None else moves.at[which % len(moves.at)]
    assert moves.one(at) == moves.of(np.array([at], np.int64))[0]
