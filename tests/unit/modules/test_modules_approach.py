"""The way of `joint_pid`, `pd_grav` and `computed_torque` from the robot to Q_REF."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pbonet.modules.controllers._approach import Approach
from pbonet.modules.controllers.joint_pid import JointPID
from pbonet.modules.controllers.pd_grav import PdGrav
from pbonet.testing import Bench

DT = 0.002
AWAY = np.array([0.1, -0.05])
LAWS = {
    JointPID: {"kp": 1.0, "kd": 0.0, "limit": 100.0},
    PdGrav: {"kp": (1.0,), "kd": (0.0,), "limit": (100.0,), "fade": DT},
}
"""With these T_REF is the reference that a cycle goes by, as Q_MEZ is zero."""


@pytest.fixture(params=LAWS, ids=["joint_pid", "pd_grav"])
def bench(request) -> Bench[Any]:
    """A controller whose robot is at zero, while Q_REF is `AWAY` from there."""
    made = Bench(request.param, params=LAWS[request.param], freq=1 / DT, ndof=2)
    made.inputs.q_ref = -AWAY
    made.on()
    return made


@pytest.mark.parametrize("speed", [0.0, 2.0, -30.0])
def test_it_arrives_however_fast_the_reference_moves(bench, speed) -> None:
    """The reference becomes nearer by SPEED * dt in each cycle, and then is Q_REF."""
    left = []
    for n in range(120):
        bench.inputs.q_ref = n * DT * speed - AWAY
        bench.step()
        left.append(bench.outputs.tau - bench.inputs.q_ref)
    steps = -np.diff(left, axis=0) * np.sign(AWAY)
    most = 0.5 * DT
    assert steps[1:40] == pytest.approx(np.full((39, 2), most)), "both are on the way"
    assert (steps > -1e-12).all()
    assert (steps[1:] < most + 1e-12).all(), "pd_grav fades until its second cycle"
    assert np.abs(left[101:]).max() == 0.0, "0.1 rad at 0.5 rad/s"


def test_a_cycle_that_was_aborted_does_not_end_the_way(bench) -> None:
    bench.step(n=20)
    before = bench.outputs.tau.copy()
    bench.executor.abort()
    bench.step(n=2)
    assert np.abs(bench.outputs.tau - before).max() <= 2 * 0.5 * DT + 1e-12
    bench.step(n=100)
    assert bench.outputs.tau == pytest.approx(-AWAY)


def test_what_was_left_of_an_earlier_way_is_no_distance_from_a_predecessor(bench):
    bench.step(n=20)
    bench.off(handover=True)
    bench.inputs.q = -AWAY  # to which the successor moved it
    bench.on(handover=True)
    bench.step(n=2)
    assert bench.outputs.tau == pytest.approx([0.0, 0.0])
    assert not bench.module._approach.goes_on


def test_each_turning_on_begins_where_the_robot_is_by_then(bench) -> None:
    bench.step(n=20)
    bench.off()
    bench.inputs.q = [0.02, 0.03]
    bench.on()
    bench.step(n=2)
    assert np.abs(bench.outputs.tau).max() <= 2 * 0.5 * DT + 1e-12


@pytest.mark.parametrize("handover", [False, True])
def test_a_distance_that_is_no_number_does_not_stay(handover) -> None:
    way, task = Approach(2), Bench(JointPID, params=LAWS[JointPID], ndof=2).module.task
    task.handover = handover
    way.begin(task, np.array([0.2, np.inf]), np.array([np.nan, 0.1]))
    assert not way.goes_on


def test_no_time_moves_nothing_and_nothing_is_allocated() -> None:
    way, task = Approach(2), Bench(JointPID, params=LAWS[JointPID], ndof=2).module.task
    way.begin(task, np.zeros(2), AWAY)
    found = way.of(np.zeros(2), 0.5, 0.0)
    assert found.tolist() == AWAY.tolist()
    assert way.of(np.zeros(2), np.array([0.5, 0.1]), DT) is found
    assert found == pytest.approx(AWAY - [0.5 * DT, -0.1 * DT])
