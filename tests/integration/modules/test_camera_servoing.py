"""A ball is followed by the pictures of a camera that is drawn beside the tasks."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from drawn_pictures import EXAMPLE, skip_without_egl
from watching import states, wait_for

from pbonet import Subsystem
from pbonet.config import read_agent
from pbonet.errors import SppError
from pbonet.log import STABLE
from pbonet.testing import verify
from pbonet.xm.net import messages as m, statuses

EYE, TARGET = ["eye"], ["target"]
STAYING = ("puma_pidg", "grav_comp", "forward_kin", "ball", "qrdiff", "puma_inv_kin")
NEAR = 0.03
"""m; how well the ball is followed."""
MAX_AGE = 1.0
"""Seconds; that of Q_REF, after which the arm is on its own."""
FRESH = 0.2
"""Seconds; a machine that stands still shows the ball where it was."""
SETTLED = 1_000_000_000
"""Nanoseconds after which a swap, or a time without pictures, has no effect more."""


@pytest.fixture
def arm(nodes):
    nodes.agent_process("arm0", wait=False)
    found = read_agent(EXAMPLE / "agent.toml").spp
    nodes.agent_process("arm1", spp=found, libraries=(str(EXAMPLE),))
    nodes.wait_agent("arm0", nodes.processes["arm0"])
    with Subsystem(EXAMPLE / "simulated.job", domain=nodes.domain) as arm:
        yield arm


def cycles(arm, task, more):
    goal = arm.status(task).cycle + more
    wait_for(lambda: arm.status(task).cycle >= goal, f"cycles of {task}")


def value(arm, name):
    return arm.display(name)[0].values[0]


def wait_for_sight(arm):
    wait_for(lambda: value(arm, "SIGHT_AGE") < 0.3, "pictures that show the ball")


def executive(nodes):
    """Return how the camera's executive is, which draws its pictures."""
    (found,) = nodes.client().call("arm1", m.Status(), statuses.RtpuStatus).spps
    return found


def test_a_ball_is_followed_by_drawn_pictures_with_a_swap_and_a_dead_executive(
    arm, nodes
):
    arm.start()
    try:
        arm.spawn("eye", "arm1")
    except SppError as error:
        skip_without_egl(error)
    cycles(arm, "ball", 120)  # it moves
    arm.swap(TARGET, EYE)
    now = states(arm)
    assert {task: now[task] for task in (*STAYING, "eye")} == dict.fromkeys(
        (*STAYING, "eye"), "ON"
    )
    wait_for_sight(arm)
    cycles(arm, "eye", 180)

    os.kill(executive(nodes).pid, signal.SIGKILL)
    wait_for(lambda: executive(nodes).starts == 2, "another executive")
    assert states(arm)["eye"] == "ON"
    wait_for_sight(arm)
    cycles(arm, "eye", 180)
    arm.swap(EYE, TARGET)
    cycles(arm, "target", 5)
    arm.finish()
    log = arm.recordings.log()

    for task in STAYING:
        assert np.all(np.diff(log.arrays(task)["cycle"]) >= 1), "it was ON all the time"
    eye, hand, ball = (log.arrays(task) for task in ("eye", "forward_kin", "ball"))
    assert eye["SIGHT_AGE"].max() > FRESH, "no pictures came for a while"
    assert eye["PICTURE"].max() > 20
    seen = followed(eye, hand["release_ns"])
    assert seen.sum() > 100
    off = distances(hand, ball)[seen]
    assert off.max() < NEAR, f"{1e3 * off.max():.1f} mm"
    (verdict,) = verify(log, EYE)
    assert verdict.good, str(verdict)
    stable = log.arrays("puma_pidg")["flags"] & STABLE
    assert stable.any() or eye["SIGHT_AGE"].max() < MAX_AGE + 0.2


def followed(eye, times):
    """Return at which times `eye` had pictures for SETTLED, none older than FRESH."""
    when, age = eye["release_ns"], eye["SIGHT_AGE"].ravel()
    lacks = when[(age > FRESH) | (when == when[0])]
    last = lacks[np.maximum(np.searchsorted(lacks, times) - 1, 0)]
    return (times - last > SETTLED) & (times <= when[-1])


def distances(hand, ball):
    """Return how far the point 0.4 m before the hand was from the ball, m."""
    pose = hand["X_MEZ"].reshape(-1, 3, 4)
    newest = np.searchsorted(ball["release_ns"], hand["release_ns"], side="right") - 1
    there = pose[:, :, 3] + 0.4 * pose[:, :, 2]
    centre = ball["X_BALL"].reshape(-1, 3, 4)[np.maximum(newest, 0), :, 3]
    return np.linalg.norm(there - centre, axis=1)
