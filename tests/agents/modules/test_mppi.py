"""The arm that goes to random goals over real agents; its processor is killed once."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from watching import wait_for

from pbonet import Subsystem
from pbonet.config import SppEntry
from pbonet.testing import verify

pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")

EXAMPLES = Path(__file__).parents[3] / "examples"
LIBRARIES = [str(EXAMPLES / name) for name in ("mppi", "panda")]


def value(arm, name):
    return np.array(arm.display(name)[0].values)


def processor(arm):
    return next(one for rtpu in arm.rtpu_status() for one in rtpu.spps)


def goals(arm, count):
    wait_for(lambda: value(arm, "GOALS").sum() >= count, f"{count} goals")


@pytest.fixture
def recording(nodes):
    nodes.agent_process("arm0", wait=False, libraries=LIBRARIES)
    nodes.agent_process(
        "arm1", wait=False, libraries=LIBRARIES, spp={"gpu0": SppEntry(driver="numpy")}
    )
    for name in ("arm0", "arm1"):
        nodes.wait_agent(name, nodes.processes[name])
    arm = Subsystem(
        EXAMPLES / "mppi" / "goals.job", domain=nodes.domain, libraries=LIBRARIES
    )
    arm.open()
    try:
        arm.start()
        arm.set("plan", "ROLLOUTS", 96)
        goals(arm, 1)
        first = processor(arm)
        assert first.libraries == ["pbonet.io.mppi.kernels on numpy cpu"]
        os.kill(first.pid, signal.SIGKILL)
        wait_for(lambda: processor(arm).starts == 2, "another executive")
        goals(arm, value(arm, "GOALS").sum() + 2)
    finally:
        arm.finish()
    return arm.recordings.log()


def test_it_reaches_goals_outlives_its_processor_and_is_replayed(recording):
    plan = recording.arrays("plan")
    age = plan["PLAN_AGE"].ravel()
    # From the kill to the new executive its plan got old, and then it went on.
    begin = np.flatnonzero(np.diff(age) < 0.0)[0]  # behind the first plan
    longest = begin + int(np.argmax(age[begin:]))
    assert age[longest] > 0.1
    assert np.abs(plan["Q^_REF"][longest:]).max() > 0.5
    change = np.diff(plan["Q^_REF"], axis=0)
    assert np.array_equal(np.sign(change), np.sign(plan["Q^^_REF"][1:]))
    most = np.array([8.0, 8, 8, 8, 10, 10, 10])
    assert np.all(np.abs(plan["Q^^_REF"]) <= most * (1 + 1e-9))
    reached, given_up = recording.arrays("goals")["GOALS"][-1]
    assert reached >= 2
    assert reached > given_up
    for verdict in verify(recording, ["plan", "goals"]):
        assert verdict.good, str(verdict)
