"""Logs that go on in another file, give way to newer ones, or wait for an error."""

from __future__ import annotations

import os

import pytest
from adding_module import ADDS
from log_of_real_tasks import begin, cycles_of, end, exercise, without_a_hole
from watching import wait_for

from pbonet.errors import LogError
from pbonet.log import Log, is_complete
from pbonet.testing import verify
from pbonet.xm.net import messages as m

FAILS = "\n        if self.params.gain > 99.0:\n            raise OSError"
RAISES = ADDS.replace("self.age += dt / 3.0", f"self.age += dt / 3.0{FAILS}")


@pytest.fixture
def start(nodes):
    """Start an agent with these limits; return a master."""

    def agent(**limits):
        nodes.write_module("adds", RAISES)
        nodes.agent_process("arm0", **limits)
        return nodes.master("arm0", "arm")

    return agent


def is_split(line):
    """Tell whether a third file is being written."""
    _, dash, number = line.rtpu_status().log.removesuffix(".mcap").rpartition("-")
    return dash and number.isdecimal() and int(number) > 2


def test_a_log_goes_on_in_another_file_and_is_verified_as_one(start) -> None:
    line = start(log_mb=0.02)
    path = begin(line)
    exercise(line)
    wait_for(lambda: is_split(line), "a third file")
    log = end(line, path)
    abouts = [part.about for part in log.parts]
    assert all(part.complete for part in log.parts)
    assert [one.part for one in abouts] == list(range(1, len(abouts) + 1))
    assert [one.goes_on for one in abouts] == [False] + [True] * (len(abouts) - 1)
    for task in ("a", "b"):
        (life,) = log.lives(task)
        assert without_a_hole(cycles_of(life))
    verdicts = verify(log)
    assert all(one.good for one in verdicts), "\n".join(map(str, verdicts))
    last = Log(log.parts[-1].path)
    assert "begins amid the task's life" in str(verify(last, ["b"])[0])


def test_the_oldest_logs_give_way(start, runs) -> None:
    old = runs / "2020-01-01T00-00-00.000-old" / "run.mcap"
    old.parent.mkdir(parents=True)
    old.write_bytes(bytes(200_000))
    os.utime(old, (1e9, 1e9))
    fresh = runs / "other" / "run.mcap"
    fresh.parent.mkdir()
    fresh.write_bytes(bytes(1000))
    line = start(runs_mb=0.15)
    path = begin(line)
    event = line.wait_event("LOG_REMOVED")
    assert str(old) in event.text
    assert not old.parent.exists()
    assert fresh.exists(), "somebody may be writing it"
    wait_for(lambda: is_split(line), "files of a share of the limit")
    log = end(line, path)
    assert all(part.size < 150_000 for part in log.parts)


def test_only_the_last_seconds_are_written_and_only_behind_an_error(start) -> None:
    line = start()
    path = begin(line, last=30.0)
    line.wait_cycles("b", 100)
    assert line.rtpu_status().log == ""
    line.ask(m.Set(task="a", name="gain", value="100"))
    wait_for(lambda: is_complete(path), "a log of what went before the error")
    log = Log(path)
    cycles = cycles_of(*log.lives("b"))
    assert without_a_hole(cycles)
    assert cycles[0] == 1
    assert len(cycles) > 100, "with what came behind the error"
    told = [event for event in log.events() if event["task"] == "a"]
    assert any(event["severity"] >= 40 for event in told)
    assert any(event["code"] == "SPAWNED" for event in told)
    wait_for(lambda: not line.rtpu_status().log, "the end of that log")
    error = line.refused(LogError, line.ask, m.Record(run="r", last=-1.0))
    assert "this many seconds cannot be kept" in str(error)
