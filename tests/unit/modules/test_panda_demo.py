"""The seven-axis arm in virtual time: a circle, and swaps of its kinematics."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from pbonet import Subsystem
from pbonet.config import Library, read_rmod, read_svar
from pbonet.io import RobotModel
from pbonet.pbo import decode_params

EXAMPLE = Path(__file__).parents[3] / "examples" / "panda"

pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")
pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")


def configured(file: Path) -> Any:
    rmod = read_rmod(file)
    return decode_params(Library().load(rmod.module).cls, rmod.local)


@pytest.fixture(scope="module")
def demo() -> ModuleType:
    spec = importlib.util.spec_from_file_location("panda_demo", EXAMPLE / "demo.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_hand_stays_on_the_circle_through_both_swaps(demo: ModuleType) -> None:
    recording = demo.run(sim=True)
    result = demo.judge(recording)
    assert result.rms < 0.2
    assert result.far < 0.5
    assert result.step < 1e-3
    assert result.gap_ms == pytest.approx(4.0), "no cycle of the reference is lost"
    assert not any(result.lost.values())
    _, there, _ = demo.hand(recording)
    size = np.ptp(there, axis=0)
    assert size == pytest.approx([0.0, 0.1, 0.1], abs=5e-4), "10 cm across"
    time, _ = demo.references(recording)
    damped = recording.arrays("ik_damped")["release_ns"]
    assert len(damped) == pytest.approx(2.5 * 250, abs=2)
    assert len(time) == len(set(time.tolist())), "one writer in each cycle"


def test_the_arm_begins_with_the_torque_that_holds_it() -> None:
    variables = {one.name: one for one in read_svar(EXAMPLE / "panda.svar").variables}
    model = RobotModel("panda.urdf", [EXAMPLE])
    home = np.array(variables["Q_MEZ"].init)
    pose = np.empty((3, 4))
    model.pose(home, model.frame("hand"), pose)
    assert variables["Q_REF"].init == variables["Q_MEZ"].init
    assert variables["T_REF"].init == pytest.approx(model.gravity(home), abs=1e-7)
    assert variables["X_DES"].init == pytest.approx(pose.ravel(), abs=1e-8)


def test_limits_in_the_files_are_those_of_the_robot() -> None:
    variables = {one.name: one for one in read_svar(EXAMPLE / "panda.svar").variables}
    model = RobotModel("panda.urdf", [EXAMPLE])
    limits = configured(EXAMPLE / "q_int.rmod")
    for name in ("Q_REF", "Q_MEZ"):
        assert variables[name].min == pytest.approx(model.lower)
        assert variables[name].max == pytest.approx(model.upper)
    assert variables["T_REF"].max == pytest.approx(model.effort)
    assert limits.lower == pytest.approx(model.lower)
    assert limits.upper == pytest.approx(model.upper)


def test_when_torques_stop_the_arm_stays_and_goes_on_when_they_come_again() -> None:
    with Subsystem(EXAMPLE / "circle.job", virtual=True) as arm:
        arm.start()
        arm.wait(1.5)
        arm.off("torque")
        arm.wait(1.0)
        stood = np.array(arm.display("Q_MEZ")[0].values)
        assert np.abs(arm.display("Q^_MEZ")[0].values).max() < 1e-3
        arm.wait(0.5)
        assert arm.display("Q_MEZ")[0].values == pytest.approx(stood, abs=1e-4)
        arm.on("torque")
        arm.wait(3.0)
        (wanted,), (there,) = arm.display("X_DES"), arm.display("X_MEZ")
        assert there.values == pytest.approx(wanted.values, abs=1e-3)
