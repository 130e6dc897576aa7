"""The quadruped in virtual time: it squats, is pushed, and stands."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from pbonet import Subsystem
from pbonet.config import Library, read_svar
from pbonet.io import FloatingModel, MujocoRobot
from pbonet.testing import Bench

EXAMPLE = Path(__file__).parents[3] / "examples" / "quadruped"
FEET = ("lf_foot", "lh_foot", "rf_foot", "rh_foot")

mujoco = pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")
pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")


@pytest.fixture(scope="module")
def demo() -> ModuleType:
    spec = importlib.util.spec_from_file_location("quadruped_demo", EXAMPLE / "demo.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def variables() -> dict[str, Any]:
    found = read_svar(EXAMPLE / "quadruped.svar").variables
    return {one.name: one for one in found}


@pytest.mark.slow
def test_it_squats_by_5_cm_is_pushed_and_stands(demo: ModuleType) -> None:
    recording = demo.run(sim=True)
    result = demo.judge(recording)
    assert result.stands
    assert result.depth == pytest.approx(50.0, abs=2.0)
    assert result.rms < 1.5
    assert 4.0 < result.away < 20.0, "the push is felt"
    assert result.left < 1.5, "and made up"
    assert result.tilt < 2.0
    assert result.feet == 4
    assert not any(result.lost.values())
    for task in ("robot", "torque", "posture", "touch"):
        periods = np.diff(recording.arrays(task)["release_ns"])
        assert set(periods.tolist()) == {2_000_000}, "500 Hz"
    time, force = recording.series("F_FEET")
    up = force.reshape(-1, 4, 3)[:, :, 2].sum(axis=1)
    still = (time - time[0] > 0.2) & (time - time[0] < 0.9)
    assert up[still] == pytest.approx(11.8 * 9.81, rel=0.01), "its weight"
    steps = np.abs(np.diff(recording.arrays("torque")["T_REF"], axis=0))
    assert steps.max() < 0.5, "no torque jumps by more, N*m, not at the push either"


def test_a_robot_that_falls_is_said_to_fall(demo: ModuleType) -> None:
    class Fallen:
        def series(self, name: str) -> tuple[np.ndarray, np.ndarray]:
            pose = np.tile(np.column_stack((np.eye(3), [0, 0, 0.1])).ravel(), (9, 1))
            return np.arange(9.0), np.ones((9, 4)) if name == "CONTACT" else pose

        def missed(self) -> dict[str, int]:
            return {}

    assert not demo.judge(Fallen()).stands


def test_when_torques_stop_the_robot_stays_and_goes_on_when_they_come_again() -> None:
    with Subsystem(EXAMPLE / "squat.job", virtual=True) as robot:
        robot.start()
        robot.wait(0.2)
        robot.off("torque")
        robot.wait(0.3)
        (pose,), (speed,) = robot.display("X_MEZ"), robot.display("Q^_MEZ")
        assert pose.values[11] == pytest.approx(0.32, abs=0.01)
        assert np.abs(speed.values).max() < 0.05
        robot.on("torque")
        robot.wait(0.4)  # the squat begins after 1 s
        (pose,) = robot.display("X_MEZ")
        assert pose.values[11] == pytest.approx(0.32, abs=2e-3)


def test_both_files_are_the_same_robot() -> None:
    """By the mass matrix, gravity and the feet, in any posture."""
    rng = np.random.default_rng(0)
    pin = pytest.importorskip("pinocchio")
    robot = MujocoRobot("quadruped.xml", [EXAMPLE], floats=True)
    model = FloatingModel("quadruped.urdf", [EXAMPLE])
    assert robot.joints == model.joints.joints
    low, high = robot._bounds
    assert high == pytest.approx(model.joints.effort)
    assert low == pytest.approx(-model.joints.effort)
    ranges = robot._model.jnt_range[1:]
    assert ranges[:, 0] == pytest.approx(model.joints.lower)
    assert ranges[:, 1] == pytest.approx(model.joints.upper)
    assert robot._model.dof_damping[6:] == pytest.approx(model.joints.damping)
    q, pose = rng.uniform(-0.5, 0.5, 12), np.column_stack((np.eye(3), [0, 0, 1.0]))
    robot.place(q, np.zeros(12))
    robot.place_base(pose, np.zeros(6))
    model.move(pose, np.zeros(6), q, np.zeros(12))
    for foot in FEET:
        pin.framesForwardKinematics(model._model, model._data, model.q)
        place = model._data.oMf[model.frame(foot)]
        seen = robot._data.geom(foot).xpos
        assert place.translation == pytest.approx(seen, abs=1e-9), foot
    ours = np.zeros((18, 18))
    for row, unit in zip(ours, np.eye(18), strict=True):
        mujoco.mj_mulM(robot._model, robot._data, row, unit)
    mass = pin.crba(model._model, model._data, model.q)
    assert np.triu(ours) == pytest.approx(np.triu(mass), abs=1e-9)
    theirs = pin.computeGeneralizedGravity(model._model, model._data, model.q)
    assert robot._data.qfrc_bias == pytest.approx(theirs, abs=1e-9)


def test_it_begins_as_it_stands(variables: dict[str, Any]) -> None:
    """Posture, torques and forces of the table are what the modules say."""
    init = {name: np.array(one.init) for name, one in variables.items() if one.init}
    assert init["X_MEZ"] == pytest.approx(init["X_BODY_DES"])
    assert init["T_MEZ"] == pytest.approx(init["T_REF"])
    posture = Bench.of(
        EXAMPLE / "posture.rmod",
        {
            "ndof": 12,
            "x_body": init["X_BODY_DES"].reshape(3, 4),
            "x_feet": init["X_FEET_DES"].reshape(4, 3),
            "q_ref": init["Q_REF"],
        },
        library=[EXAMPLE],
    )
    posture.on()
    posture.step(n=3)
    assert posture["Q_REF"] == pytest.approx(init["Q_MEZ"], abs=1e-6)
    torque = Bench.of(
        EXAMPLE / "torque.rmod",
        {
            "ndof": 12,
            "x_des": init["X_BODY_DES"].reshape(3, 4),
            "x": init["X_MEZ"].reshape(3, 4),
            "contact": init["CONTACT_DES"],
            "q": init["Q_MEZ"],
            "q_ref": init["Q_REF"],
        },
        library=[EXAMPLE],
    )
    torque.on()
    torque.step(n=60)
    assert torque["T_REF"] == pytest.approx(init["T_REF"], abs=1e-3)
    contacts = torque.module._contacts
    force = np.concatenate([one.wrench for one in contacts])
    assert force == pytest.approx(init["F_FEET"], abs=1e-2)


def test_limits_of_the_table_are_those_of_the_robot(variables: dict[str, Any]) -> None:
    model = FloatingModel("quadruped.urdf", [EXAMPLE]).joints
    assert variables["Q_REF"].min == pytest.approx(model.lower)
    assert variables["Q_REF"].max == pytest.approx(model.upper)
    assert variables["T_REF"].max == pytest.approx(model.effort)
    for rmod in ("torque", "posture", "touch"):
        assert Library([EXAMPLE]).read_rmod(EXAMPLE / f"{rmod}.rmod").freq == 500
