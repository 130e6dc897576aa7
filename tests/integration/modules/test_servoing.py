"""The visual servoing example over real agents and tasks: controllers swapped live."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from watching import states, wait_for

EXAMPLE = Path(__file__).parents[3] / "examples" / "servoing"
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
    nodes.agent_processes("arm0", "arm1")
    job = EXAMPLE / "inverse.job"
    return load("steering").Steering(job, domain=nodes.domain)


SLOWLY = ("0", "1", "13")
"""When the target reaches its poses, s: a third as fast as in the example, so that
there is time to swap."""
TOWARDS, CLOSE = 0.35, 0.05
"""SIGMA below which the controllers are swapped, and that is passed then."""
FAST = 1.0
"""rad/s; the singularity asks joint 4 for six times that of inverse kinematics."""


def cycles(subsystem, task, more):
    goal = subsystem.status(task).cycle + more
    wait_for(lambda: subsystem.status(task).cycle >= goal, f"cycles of {task}")


def writer(arm):
    return arm.display(["Q_REF"])[0].writer


@pytest.fixture
def recording(steering):
    """Every cycle of a run past the singularity, with a swap before and one behind."""
    demo = load("demo")
    steering.begin(demo.SPARE)
    try:
        arm = steering.subsystem
        arm.set("target", "TIME", SLOWLY)

        def sigma(passed, why):
            wait_for(lambda: passed(steering.value("SIGMA")), why)

        cycles(arm, "target", 30)  # the first looks at the target make the arm move
        sigma(lambda now: now < TOWARDS, "an arm on its way to the singularity")
        arm.swap(demo.INVERSE, demo.DAMPED)
        assert writer(arm) == "qrint"
        assert states(arm)["puma_inv_kin"] == "OFF"
        sigma(lambda now: now < CLOSE, "the singularity")
        sigma(lambda now: now > TOWARDS, "an arm behind the singularity")
        arm.swap(demo.DAMPED, demo.INVERSE)
        cycles(arm, "puma_inv_kin", 50)
        assert writer(arm) == "puma_inv_kin"
        now = states(arm)
        assert {task: now[task] for task in STAYING} == dict.fromkeys(STAYING, "ON")
    finally:
        made = steering.end()
    return made


def test_past_a_singularity_with_the_controllers_swapped_in_real_time(recording):
    for task in STAYING:
        number = recording.arrays(task)["cycle"]
        assert np.all(np.diff(number) >= 1), f"{task} was never turned on anew"
    both = [recording.arrays(task) for task in ("puma_inv_kin", "qrint")]
    when = np.concatenate([one["release_ns"] for one in both])
    order = np.argsort(when)
    reference = np.concatenate([one["Q_REF"] for one in both])[order]
    writers = np.repeat([0, 1], [len(one["cycle"]) for one in both])[order]
    turns = np.flatnonzero(np.diff(writers))
    assert list(writers[[0, *(turns + 1)]]) == [0, 1, 0]

    # damped least squares had the arm where it was singular, and hurried no joint
    begun, ended = both[1]["release_ns"][[0, -1]]

    def then(task, variable):
        arrays = recording.arrays(task)
        held = (arrays["release_ns"] >= begun) & (arrays["release_ns"] <= ended)
        return arrays[variable][held]

    assert then("forward_kin", "SIGMA").min() < CLOSE
    asked = np.abs(then("damped_ls", "Q^_CMD")).max(axis=1)
    assert np.quantile(asked, 0.95) < FAST
    moved = np.abs(then("puma_pidg", "Q^_MEZ")).max(axis=1)
    assert np.quantile(moved, 0.95) < FAST  # a machine that stood still costs a step

    # nor is one at the swaps: by cycles, however long they took
    passed = np.diff(when[order]) * 1e-9
    steps = np.abs(np.diff(reference, axis=0)).max(axis=1)
    assert np.all(steps[turns] < 2.0 * passed[turns] + 0.03)
