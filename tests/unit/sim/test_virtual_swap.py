"""A program in virtual time swaps tasks as on agents, also from one RTPU to another."""

from __future__ import annotations

import pytest
from test_sim_rules import SOURCE, WAITS, Shop

from pbonet.errors import NodeError
from pbonet.master import Subsystem


@pytest.fixture
def arm(tmp_path):
    """A source at 100 Hz on RTPU a; another one of 50 Hz waits to take its place."""
    shop = Shop(tmp_path)
    shop.module("fast", SOURCE, "OUTVAR Y", "FREQ 100")
    shop.module("slow", SOURCE, "OUTVAR Y", "FREQ 50")
    shop.job("fast a")
    server = ("TASKTYPE sporadic", "FREQ 10", "CAPACITY 0.01")
    shop.module("server", SOURCE + WAITS, "OUTVAR Y", *server)
    path, libraries = tmp_path / "test.job", [tmp_path / "lib"]
    with Subsystem(path, libraries=libraries, virtual=True) as subsystem:
        subsystem.start()
        subsystem.wait(0.1)
        yield subsystem


@pytest.mark.parametrize("rtpu", ["a", "b"])
def test_the_new_task_comes_as_the_old_one_ends(arm, rtpu):
    arm.spawn("slow", rtpu)
    begun = arm.clock.now()
    arm.swap("fast", "slow")
    assert arm.clock.now() - begun < 0.01, "no cycle of time is needed"
    assert {one.task: one.state for one in arm.status_all()} == {
        "fast": "OFF",
        "slow": "ON",
    }
    assert arm.display("Y")[0].writer == "slow"
    arm.wait(0.1)
    assert arm.rtpu_status()[0].illegal == []
    assert not [one for one in arm.events() if one.code == "ILLEGAL"]
    recording = arm.simulation.recording
    counts = [*recording.arrays("fast")["Y"], *recording.arrays("slow")["Y"]]
    assert [int(one[0]) for one in counts] == list(range(1, 16)), "none is lost"
    arm.swap("slow", "fast")
    assert arm.display("Y")[0].writer == "fast"


def test_the_new_task_was_called_by_the_old_one(arm):
    arm.spawn("slow", "b")
    arm.swap("fast", "slow")
    assert [one.text for one in arm.events() if one.code == "ENGAGED"] == [
        "in place of fast"
    ]


def test_a_task_that_time_does_not_drive_is_refused(arm):
    with pytest.raises(NodeError, match="a sporadic task cannot be simulated"):
        arm.spawn("server")
    assert [one.task for one in arm.status_all()] == ["fast"]
