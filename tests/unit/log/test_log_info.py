"""What ``log info`` says: states over time, gaps, rates, misses."""

from __future__ import annotations

import json
import random

import pytest
from made_logs import PLAIN, about, group, record, run

from pbonet.log import Log, LogWriter, text
from pbonet.log.states import timelines

MS = 10**6
DATA = group(PLAIN, random.Random(1))[0]


def happened(ms, state, task="pid", code="STATE", rtpu="arm0"):
    named = {"severity": 20, "text": "", "rtpu": rtpu, "task": task}
    return {"time": ms * MS, "code": code, "state": state, **named}


def cycles(writer, number, times):
    for n, at in times:
        ns = at * MS
        one = record(DATA, cycle=n, release_ns=ns, start_ns=ns, end_ns=ns)
        writer.add(number, one)


@pytest.fixture
def log(tmp_path):
    """A task that was OFF twice and in ERROR once, one that died, and one without."""
    writer = LogWriter(tmp_path / "run.mcap", run())
    pid = writer.add_task(about("pid", PLAIN))
    dies = writer.add_task(about("dies", PLAIN))
    sim = writer.add_task(about("sim", PLAIN))
    cycles(writer, pid, [(1, 110), (2, 120), (3, 130), (4, 150), (5, 160)])
    cycles(writer, pid, [(9, 200)])  # four records are lost
    cycles(writer, pid, [(10, 5010), (11, 5020)])
    cycles(writer, dies, [(1, 110), (2, 120)])
    cycles(writer, sim, [(1, 0), (2, 20), (3, 30), (4, 40), (5, 60000), (6, 60010)])
    for event in (
        happened(100, "OFF", code="SPAWNED"),
        happened(105, "ON"),
        happened(110, "ON", task="dies"),
        happened(140, "ON", code="WARNING"),
        happened(141, "NOT-CREATED", task="dies", code="TASK_DIED"),
        happened(205, "ERROR", code="METHOD"),
        happened(1205, "OFF"),
        happened(5000, "ON"),
        happened(5500, "OFF"),
        happened(5501, "", task="", code="STOPPED", rtpu="arm1"),
        happened(6000, "", task="", code="STOPPED"),
    ):
        writer.add_event(event)
    writer.close()
    return Log(tmp_path)


def test_states_are_told_over_time_with_their_durations(log) -> None:
    told = [(one.state, one.begin_ns // MS) for one in timelines(log)["pid"]]
    assert told == [
        *[("OFF", 100), ("ON", 105), ("ERROR", 205), ("OFF", 1205)],
        *[("ON", 5000), ("OFF", 5500), ("NOT-CREATED", 6000)],
    ]
    data = json.loads(json.dumps(text.info(log)))
    pid, dies, sim = (data["tasks"][task] for task in ("pid", "dies", "sim"))
    states = {"OFF": 4.3, "ON": 0.6, "ERROR": 1.0, "NOT-CREATED": 54.01}
    assert pid["states"] == pytest.approx(states)
    assert pid["timeline"][1] == ["ON", 0.105]
    assert dies["states"] == pytest.approx({"ON": 0.031, "NOT-CREATED": 59.869})
    assert sim["states"] == {}
    lines = text.info_text(data).splitlines()
    (line,) = [one for one in lines if one.startswith("pid") and "ERROR" in one]
    assert line.split()[:4] == ["pid", "0.60", "4.30", "1.00"]
    assert "ON, 0.20 ERROR, 1.21 OFF, 5.00 ON, 5.50 OFF" in line


def test_gaps_are_counted_where_the_task_was_on(log) -> None:
    tasks = text.info(log)["tasks"]
    assert (tasks["pid"]["gaps"], tasks["dies"]["gaps"]) == (1, 0)
    assert tasks["pid"]["longest"] == pytest.approx(0.04)
    assert tasks["pid"]["missed"] == 4  # nobody counted: of distances while it was ON
    assert (tasks["pid"]["hz"], tasks["pid"]["freq"]) == pytest.approx((100.0, 100.0))
    assert tasks["sim"]["missed"] == 1  # a thousand periods are a time OFF
    assert tasks["sim"]["longest"] == pytest.approx(0.02)
    assert "40.00 ms" in text.info_text(text.info(log))


def test_of_many_changes_the_first_are_shown(tmp_path) -> None:
    writer = LogWriter(tmp_path / "run.mcap", run())
    cycles(writer, writer.add_task(about("pid", PLAIN)), [(1, 0), (2, 1000)])
    for n in range(20):
        writer.add_event(happened(10 * n, ("ON", "OFF")[n % 2]))
    writer.close()
    told = text.info_text(text.info(Log(tmp_path)))
    assert "0.07 OFF, and 12 more" in told


def test_missed_releases_are_those_that_were_counted(tmp_path) -> None:
    """A gap need not be a miss: the rate may have changed, or the task was OFF."""
    writer = LogWriter(tmp_path / "run.mcap", run())
    number = writer.add_task(about("pid", PLAIN))
    sim = writer.add_task(about("sim", PLAIN))
    data = group(PLAIN, random.Random(1))[0]
    for n, release in enumerate((0, 10, 20, 40, 60, 80)):
        for one in (number, sim):
            writer.add(one, record(data, cycle=n + 1, release_ns=release * 10**6))
    told = [(2, 0), (5, 3), (6, 3), (1, 0), (4, 2)]  # spawned twice
    for n, (ran, missed) in enumerate(told):
        counts = {"cycles": ran, "missed": missed, "failed": 2 * missed}
        writer.add_status(n, {"tasks": {"pid": counts}})
    writer.close()
    tasks = text.info(Log(tmp_path))["tasks"]
    assert tasks["pid"]["missed"] == 5
    assert tasks["pid"]["failed"] == 10
    assert tasks["sim"]["failed"] == 0
    assert tasks["sim"]["missed"] == 0  # nobody counted: the usual distance is 20
