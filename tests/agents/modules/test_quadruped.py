"""The quadruped over real agents and tasks: it squats, is pushed, and stands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from watching import wait_for

from pbonet import Subsystem

pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")
pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")

EXAMPLE = Path(__file__).parents[3] / "examples" / "quadruped"


def cycles(robot, task, more, *, least=0):
    goal = max(robot.status(task).cycle + more, least)
    wait_for(lambda: robot.status(task).cycle >= goal, f"cycles of {task}")


@pytest.fixture
def recording(nodes):
    nodes.agent_processes("legs0", "legs1", libraries=[str(EXAMPLE)])
    robot = Subsystem(EXAMPLE / "squat.job", domain=nodes.domain)
    robot.open()
    try:
        robot.start()
        cycles(robot, "squat", 1600)
        robot.set("robot", "push", "0 -20 0")
        cycles(robot, "robot", 500, least=2001)
    finally:
        robot.finish()
    return robot.recordings.log()


def test_in_real_time_it_squats_is_pushed_and_stands(recording):
    """Whatever cycles were late: then the robot holds its posture."""
    time, pose = recording.series("X_MEZ")
    body = pose.reshape(-1, 3, 4)
    height = body[:, 2, 3]
    assert height.max() - height.min() == pytest.approx(0.05, abs=0.02), "it squats"
    assert height.min() > 0.24
    assert height[-1] == pytest.approx(0.32, abs=0.01), "and stands"
    assert np.abs(np.diff(body[:, 1, 3])).sum() > 0.004, "it was pushed"
    assert body[:, 2, 2].min() > 0.95, "upright"
    assert len(time) > 2000
