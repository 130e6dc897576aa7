"""The visual servoing example over real agents and tasks: controllers swapped live."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from watching import wait_for

EXAMPLE = Path(__file__).parents[2] / "examples" / "servoing"
STAYING = ("puma_pidg", "grav_comp", "forward_kin", "target", "qrdiff")


def load(name):
    spec = importlib.util.spec_from_file_location(
        f"servoing_{name}", EXAMPLE / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def steering(nodes):
    nodes.agent_process("arm0")
    nodes.agent_process("arm1")
    job = EXAMPLE / "inverse.job"
    return load("steering").Steering(job, domain=nodes.domain)


def cycles(subsystem, task, more):
    goal = subsystem.status(task).cycle + more
    wait_for(lambda: subsystem.status(task).cycle >= goal, f"cycles of {task}", 30.0)


def test_controllers_are_swapped_back_and_forth_while_the_arm_moves(steering):
    demo = load("demo")
    steering.begin(demo.SPARE)
    try:
        arm = steering.subsystem
        # until the target moves, which it does 1.08 s after it was turned on
        wait_for(lambda: steering.value("X^_DES") != 0.0, "a target that moves", 30.0)
        cycles(arm, "puma_inv_kin", 20)
        arm.swap(demo.INVERSE, demo.DAMPED)
        cycles(arm, "qrint", 50)
        (reference,) = arm.display(["Q_REF"])
        assert reference.writer == "qrint"
        states = {task.task: task.state for task in arm.status_all()}
        assert states["puma_inv_kin"] == "OFF"
        arm.swap(demo.DAMPED, demo.INVERSE)
        cycles(arm, "puma_inv_kin", 50)
        (reference,) = arm.display(["Q_REF"])
        assert reference.writer == "puma_inv_kin"
        states = {task.task: task.state for task in arm.status_all()}
        assert {task: states[task] for task in STAYING} == dict.fromkeys(STAYING, "ON")
    finally:
        recording = steering.end()

    for task in STAYING:
        arrays = recording.arrays(task)
        assert np.all(np.diff(arrays["cycle"]) >= 1), f"{task} was never turned on anew"
    both = [recording.arrays(task) for task in ("puma_inv_kin", "qrint")]
    when = np.concatenate([one["release_ns"] for one in both])
    reference = np.concatenate([one["Q_REF"] for one in both])[np.argsort(when)]
    writers = np.repeat([0, 1], [len(one["cycle"]) for one in both])[np.argsort(when)]
    turns = np.flatnonzero(np.diff(writers))
    assert list(writers[[0, *(turns + 1)]]) == [0, 1, 0]
    passed = np.diff(np.sort(when)) * 1e-9
    steps = np.abs(np.diff(reference, axis=0)).max(axis=1)
    # at the swaps no joint is asked to move faster than damped_ls ever lets it
    assert np.all(steps[turns] < 2.0 * passed[turns] + 0.03)
