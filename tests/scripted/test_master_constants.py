"""Constants between machines: a task takes them in when they have come to it."""

from __future__ import annotations

import pytest

from pbonet.errors import NoAnswerError
from pbonet.master.subsystem import constants
from pbonet.master.subsystem.subsystem import Subsystem

OLD, NEW = [0.0], [6.0]


@pytest.fixture
def robot(world, agents, puma):
    """An open subsystem; arm0 has the task that gives NDOF and DH."""
    agents("arm0", "arm1")
    agents["arm1"].machine = "another"
    with Subsystem(puma, domain=world.domain, warned=lambda _: None) as subsystem:
        subsystem.spawn("puma_pidg", "arm0")
        yield subsystem


def test_a_change_is_taken_in_when_it_has_come(robot, agents, world):
    robot.spawn("jttrace", "arm1")
    agents["arm1"].late = [{"NDOF": OLD}] * 3
    robot.write("NDOF", NEW)
    assert agents["arm1"].late == []
    assert world.log[-1] == ("arm1", "reinit jttrace")


def test_a_change_is_seen_where_it_was_made(robot, agents, world):
    """The keeper of the table, on another machine, does not have it yet."""
    robot.spawn("jttrace", "arm1")
    robot.kill("puma_pidg")
    robot.spawn("puma_pidg", "arm1")
    world.values["puma"]["NDOF"] = NEW
    agents["arm0"].late = [{"NDOF": OLD}] * 1000
    agents["arm1"].late = [{"NDOF": OLD}]  # before the change
    robot.reinit("puma_pidg")
    assert world.log[-1] == ("arm1", "reinit jttrace")


def test_a_task_is_created_when_constants_have_come(robot, agents):
    agents["arm1"].late = [{"NDOF": OLD}] * 3
    agents["arm0"].late = [{"NDOF": NEW}] * 4
    robot.spawn("jttrace", "arm1")
    assert agents["arm1"].late == []


def test_what_does_not_come_is_said(robot, agents, world, monkeypatch):
    robot.spawn("jttrace", "arm1")
    monkeypatch.setattr(constants, "ARRIVAL_TIME", 0.0)
    agents["arm1"].late = [{"NDOF": OLD}] * 1000
    with pytest.raises(NoAnswerError) as caught:
        robot.write("NDOF", NEW)
    assert str(caught.value) == (
        "arm1/jttrace: the constant NDOF has not come here (expected the value that "
        "arm0 has, within 0 s); check the connection with `pbonet doctor`; NDOF was "
        "set "
        "all the same, and this task has the old NDOF"
    )
    assert ("arm1", "reinit jttrace") not in world.log
