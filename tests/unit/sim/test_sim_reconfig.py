"""The simulator takes tasks in and swaps them while virtual time passes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from virtual_job import VirtualJob

from pbonet import State
from pbonet.errors import (
    ReconfigError,
    StateError,
    UnknownTaskError,
    VerificationError,
)

JOB = Path(__file__).parents[3] / "examples" / "servoing" / "inverse.job"
SWAP = [("puma_inv_kin", "off"), ("damped_ls", "on"), ("qrint", "on")]


@pytest.fixture
def simulation() -> VirtualJob:
    simulation = VirtualJob(JOB)
    simulation.start()
    simulation.spawn("damped_ls", "arm1")
    simulation.spawn("qrint", "arm1")
    simulation.wait(0.1)
    return simulation


def test_a_task_that_is_spawned_is_off_and_known(simulation: VirtualJob) -> None:
    assert simulation.states()["damped_ls"] is State.OFF
    assert simulation.status("qrint").rtpu == "arm1"
    assert len(simulation.recording.arrays("puma_inv_kin")["cycle"]) == 10
    with pytest.raises(StateError, match="there is a task qrint already"):
        simulation.spawn("qrint")


def test_a_list_is_carried_out_at_one_instant(simulation: VirtualJob) -> None:
    assert simulation.reconfig(SWAP) == {
        "puma_inv_kin": State.OFF,
        "damped_ls": State.ON,
        "qrint": State.ON,
    }
    assert not simulation.table.illegal
    simulation.wait(0.1)
    simulation.stop()
    assert simulation.events == []
    for task in ("puma_pidg", "forward_kin", "target", "qrdiff", "grav_comp"):
        arrays = simulation.recording.arrays(task)
        assert len(set(np.diff(arrays["release_ns"]))) == 1, "nobody missed a cycle"
        assert not arrays["flags"][2 * (task == "puma_pidg") :].any(), (
            "T_GRAV is old until gravity compensation has read a measured posture"
        )
    assert len(simulation.recording.arrays("qrint")["cycle"]) == 10


def test_velocity_is_handed_over_but_not_left_behind(simulation: VirtualJob) -> None:
    simulation.reconfig(SWAP)
    simulation.wait(2.0)
    assert np.abs(simulation.table.read("Q^_CMD")).max() > 0.1
    simulation.reconfig([
        ("qrint", "off"),
        ("damped_ls", "off"),
        ("puma_inv_kin", "on"),
    ])
    assert np.array_equal(simulation.table.read("Q^_CMD"), np.zeros(6))
    simulation.stop()


def test_a_list_that_would_end_illegal_is_refused_whole(simulation: VirtualJob) -> None:
    before = simulation.states()
    with pytest.raises(VerificationError, match="Q_REF"):
        simulation.reconfig([("damped_ls", "on"), ("qrint", "on")])
    with pytest.raises(UnknownTaskError, match="did you mean qrint"):
        simulation.reconfig([("puma_inv_kin", "off"), ("qrin", "on")])
    assert simulation.states() == before
    simulation.stop()


def test_an_item_that_fails_is_told_with_what_was_done(simulation: VirtualJob) -> None:
    with pytest.raises(ReconfigError) as caught:
        simulation.reconfig([("target", "off"), ("target", "off"), ("target", "on")])
    assert caught.value.done == 1
    assert caught.value.rest == (("target", "off"), ("target", "on"))
    simulation.stop()
