"""Bases on wheels, against rolling conditions and SE(2), on a bench."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from pbonet import State
from pbonet.errors import MethodError
from pbonet.modules.kinematics.ackermann import Ackermann
from pbonet.modules.kinematics.diff_drive import DiffDrive
from pbonet.modules.kinematics.mecanum import Mecanum
from pbonet.modules.kinematics.tricycle import Tricycle
from pbonet.testing import Bench

PARAMS = {
    DiffDrive: {"radius": 0.1, "track": 0.4},
    Mecanum: {"radius": 0.08, "length": 0.5, "track": 0.3},
    Ackermann: {"radius": 0.3, "wheelbase": 2.5, "track": 1.5, "steer": 0.6},
    Tricycle: {"radius": 0.15, "wheelbase": 1.2},
}
STEERED = Ackermann, Tricycle
BASES = list(PARAMS)
names = pytest.mark.parametrize("module", BASES, ids=lambda one: one.__name__)


def base(module, start=None, **more) -> Bench:
    table = {} if start is None else {"x": start}
    values = {name: more.pop(name) for name in ("freq", "critical") if name in more}
    bench = Bench(module, params={**PARAMS[module], **more}, **table, **values)
    bench.on()
    return bench


def drive(bench: Bench, v, steps: int, dt: float = 0.01) -> None:
    """Step with wheels that do at once what they are commanded to do."""
    bench.inputs.v_des = v
    for _ in range(steps):
        bench.step(dt)
        bench.inputs.w = bench.outputs.w_ref
        if isinstance(bench.module, STEERED):
            bench.inputs.s = bench.outputs.s_ref


def moved(v, time: float) -> np.ndarray:
    """Return the pose after a constant velocity, by the exponential of SE(2)."""
    x, y, w = v
    twist = np.array([[0.0, -w, x], [w, 0.0, y], [0.0, 0.0, 0.0]])
    plane = expm(twist * time)
    pose = np.eye(3, 4)
    pose[:2, :2], pose[:2, 3] = plane[:2, :2], plane[:2, 2]
    return pose


def said(bench: Bench) -> list[str]:
    return [notice.text for notice in bench.notices()]


def test_diff_drive_wheels_roll_without_slip() -> None:
    bench = base(DiffDrive)
    drive(bench, [0.5, 0.0, 1.2], 1)
    for y, rate in zip((0.2, -0.2), bench.outputs.w_ref, strict=True):
        assert rate * 0.1 == pytest.approx(0.5 - 1.2 * y, abs=1e-12)


def test_mecanum_rollers_roll_without_slip() -> None:
    """Along the axis of the roller on the ground, rim and ground move alike."""
    bench = base(Mecanum)
    v = np.array([0.5, -0.3, 0.7])
    drive(bench, v, 1)
    places = [(0.25, 0.15), (0.25, -0.15), (-0.25, 0.15), (-0.25, -0.15)]
    for (x, y), rate in zip(places, bench.outputs.w_ref, strict=True):
        centre = np.array([v[0] - v[2] * y, v[1] + v[2] * x])
        rim = np.array([-rate * 0.08, 0.0])  # of the point below, seen from the centre
        axis = np.array([np.sign(x), -np.sign(y)])  # across the way to the middle
        assert (centre + rim) @ axis == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("v", [(2.0, 0.0, 0.4), (-2.0, 0.0, 0.4), (3.0, 0.0, 0.0)])
def test_ackermann_wheels_move_as_they_point(v) -> None:
    bench = base(Ackermann)
    drive(bench, v, 1)
    out = bench.outputs
    for y, rate, angle in zip((0.75, -0.75), out.w_ref, out.s_ref, strict=True):
        assert rate * 0.3 == pytest.approx(v[0] - v[2] * y, abs=1e-12)
        front = np.array([v[0] - v[2] * y, v[2] * 2.5])
        across = np.array([-math.sin(angle), math.cos(angle)])
        assert front @ across == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    "v", [(2.0, 0.0, 0.4), (-2.0, 0.0, 0.4), (-0.1, 0.0, -0.7), (0.0, 0.0, -0.5)]
)
def test_a_tricycle_s_wheel_moves_as_it_points(v) -> None:
    bench = base(Tricycle)
    drive(bench, v, 2)
    front = np.array([v[0], v[2] * 1.2])
    angle, rate = bench.outputs.s_ref, bench.outputs.w_ref
    rolls = rate * 0.15 * np.array([math.cos(angle), math.sin(angle)])
    assert rolls == pytest.approx(front, abs=1e-12)
    assert abs(angle) <= math.pi / 2
    drive(bench, v, 1)
    assert bench.outputs.v == pytest.approx(v, abs=1e-12)


def test_a_tricycle_waits_for_its_wheel_to_turn() -> None:
    bench = base(Tricycle)
    bench.inputs.v_des = [0.0, 0.0, 0.5]
    for angle, share in ((0.0, 0.0), (math.pi / 6, 0.5), (math.pi / 2, 1.0)):
        bench.inputs.s = angle
        bench.step()
        assert bench.outputs.s_ref == pytest.approx(math.pi / 2)
        assert bench.outputs.w_ref == pytest.approx(share * 0.5 * 1.2 / 0.15)


@pytest.mark.parametrize("v", [1.0, -1.0, 0.0])
def test_a_tricycle_that_cannot_steer_so_far_keeps_its_speed(v) -> None:
    bench = base(Tricycle, steer=0.5)
    drive(bench, [v, 0.0, 3.0], 3)
    assert abs(bench.outputs.s_ref) == 0.5
    wanted = [v, 0.0, abs(v) * math.tan(0.5) / 1.2]
    assert bench.outputs.v == pytest.approx(wanted, abs=1e-12)


@names
@pytest.mark.parametrize("v", [(1.0, 0.0, 0.2), (0.8, 0.0, 0.0), (-0.5, 0.0, 0.1)])
def test_the_pose_is_that_of_a_constant_velocity(module, v) -> None:
    start = moved((0.4, -0.2, 1.1), 1.0)
    start[2, 3] = 0.7
    bench = base(module, start)
    assert np.array_equal(bench.outputs.x, start), "bumpless"
    drive(bench, v, 2, dt=1e-12)  # until the wheels are as they should
    drive(bench, v, 40, dt=0.05)
    assert bench.outputs.v == pytest.approx(v, abs=1e-9)
    wanted = start[:, :3] @ moved(v, 40 * 0.05)
    wanted[:, 3] += start[:, 3]
    assert np.abs(bench.outputs.x - wanted).max() < 1e-9


def test_mecanum_goes_to_the_side() -> None:
    bench = base(Mecanum)
    v = (0.3, 0.5, -0.8)
    drive(bench, v, 101)
    assert np.abs(bench.outputs.x - moved(v, 1.0)).max() < 1e-9


@names
def test_a_limit_of_the_wheels_keeps_the_path(module) -> None:
    bench = base(module, limit=1.0)
    drive(bench, [4.0, 0.0, 0.8], 2)
    assert np.abs(bench.outputs.w_ref).max() == pytest.approx(1.0)
    speed, _, turn = bench.outputs.v
    assert turn / speed == pytest.approx(0.2)


@names
def test_the_wheels_stop_when_the_command_is_old_and_the_pose_goes_on(module) -> None:
    bench = base(module)
    drive(bench, [1.0, 0.0, 0.1], 10)
    bench.ages["v_des"] = 0.6
    before = bench.outputs.x[0, 3]
    bench.step()
    assert not np.any(bench.outputs.w_ref)
    assert bench.outputs.x[0, 3] == pytest.approx(before + 0.01, abs=1e-4)
    bench.ages["v_des"] = 0.0
    bench.step(n=5)
    assert np.any(bench.outputs.w_ref)


@names
def test_the_wheels_stop_when_the_command_is_no_number(module) -> None:
    bench = base(module)
    drive(bench, [1.0, 0.0, 0.1], 3)
    drive(bench, [1.0, 0.0, math.nan], 3)
    assert not np.any(bench.outputs.w_ref)
    assert said(bench) == ["V_DES is not finite: the base stops"]
    drive(bench, [1.0, 0.0, 0.1], 1)
    assert np.any(bench.outputs.w_ref)


@names
def test_a_measurement_that_is_no_number_is_an_error(module) -> None:
    bench = base(module)
    drive(bench, [1.0, 0.0, 0.1], 3)
    before = bench.outputs.x.copy()
    bench.inputs.w = math.nan * np.asarray(bench.inputs.w)
    with pytest.raises(MethodError, match="not a finite number"):
        bench.step()
    assert np.array_equal(bench.outputs.x, before)
    bench.clear()
    bench.inputs.w = 0.0 * bench.outputs.w_ref
    bench.on()
    assert bench.step() is State.ON
    assert np.abs(bench.outputs.x - before).max() < 1e-9


@pytest.mark.parametrize("module", [DiffDrive, Ackermann])
def test_a_motion_to_the_side_is_reported_and_left_out(module) -> None:
    bench = base(module)
    drive(bench, [1.0, 0.5, 0.0], 5)
    assert said(bench) == ["V_DES asks for a motion to the side, which is left out"]
    assert bench.outputs.v == pytest.approx([1.0, 0.0, 0.0])


@names
def test_the_wheels_stop_at_the_end_but_not_for_a_successor(module) -> None:
    for handover in (False, True):
        bench = base(module)
        drive(bench, [1.0, 0.0, 0.0], 3)
        bench.off(handover=handover)
        assert np.any(bench.outputs.w_ref) == handover


def test_ackermann_keeps_its_wheels_where_they_are_at_rest() -> None:
    bench = base(Ackermann)
    drive(bench, [2.0, 0.0, 0.4], 1)
    angles = bench.outputs.s_ref.copy()
    drive(bench, [0.0, 0.0, 0.4], 3)
    assert np.array_equal(bench.outputs.s_ref, angles)
    assert not np.any(bench.outputs.w_ref)


def test_ackermann_turns_no_further_than_it_can() -> None:
    bench = base(Ackermann)
    drive(bench, [1.0, 0.0, 5.0], 2)
    assert bench.outputs.v[2] == pytest.approx(math.tan(0.6) / 2.5)
    with pytest.raises(MethodError, match=r"STEER below 1\.28 rad"):
        bench.set("steer", 1.4)
