"""The pose estimate of a base, against numerical Jacobians and least squares."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from pbonet import State
from pbonet.errors import MethodError
from pbonet.modules.sensors.ekf_odom import EkfOdom
from pbonet.testing import Bench

DT = 0.05
SIGMA = {"speed": 0.1, "turn": 0.3, "gyro": 0.1, "fix": 0.2, "heading": 0.1}


def pose(x: float, y: float, heading: float) -> np.ndarray:
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.5]])


def flat(matrix: np.ndarray) -> np.ndarray:
    return np.array([*matrix[:2, 3], math.atan2(matrix[1, 0], matrix[0, 0])])


def ekf(start=(1.0, 2.0, 0.7), **params) -> Bench[EkfOdom]:
    at = pose(*start)
    bench = Bench(EkfOdom, params={**SIGMA, **params}, freq=1 / DT, x=at, fix=at)
    bench.on()
    return bench


def moved(state: np.ndarray, v: np.ndarray, dt: float) -> np.ndarray:
    """Return x, y and heading after a constant velocity, by the matrix exponential."""
    x, y, w = v
    step = expm(dt * np.array([[0.0, -w, x], [w, 0.0, y], [0.0, 0.0, 0.0]]))
    c, s = math.cos(state[2]), math.sin(state[2])
    there = np.array([[c, -s], [s, c]]) @ step[:2, 2]
    return state + np.array([*there, w * dt])


def slope(function, at: np.ndarray) -> np.ndarray:
    h = 1e-6
    steps = h * np.eye(len(at))
    return np.array([(function(at + d) - function(at - d)) / (2 * h) for d in steps]).T


def predicted(state, p, v, gyro, dt=DT):
    """Return the textbook's prediction, with numerical derivatives."""
    a, b = 1.0 / SIGMA["turn"] ** 2, 1.0 / SIGMA["gyro"] ** 2
    fused = np.array([v[0], v[1], (a * v[2] + b * gyro) / (a + b)])
    noise = np.diag([SIGMA["speed"] ** 2, SIGMA["speed"] ** 2, 1.0 / (a + b)])
    f = slope(lambda s: moved(s, fused, dt), state)
    g = slope(lambda u: moved(state, u, dt), fused)
    return moved(state, fused, dt), f @ p @ f.T + g @ noise @ g.T


def test_the_pose_follows_wheels_and_gyroscope_exactly() -> None:
    bench = ekf()
    state = np.array([1.0, 2.0, 0.7])
    assert np.array_equal(bench.outputs.x, pose(*state)), "bumpless"
    rng = np.random.default_rng(1)
    for _ in range(12):
        v, gyro = rng.normal(size=3), rng.normal()
        bench.inputs.v, bench.inputs.gyr = v, [9.0, -9.0, gyro]
        bench.step()
        state, _ = predicted(state, np.zeros((3, 3)), v, gyro)
        assert np.abs(bench.outputs.x[:, :2] - pose(*state)[:, :2]).max() < 1e-9
        assert np.abs(bench.outputs.x[:, 3] - pose(*state)[:, 3]).max() < 1e-9


@pytest.mark.parametrize("turn", [0.8, -3.0, 0.19, 1e-3, 0.0])
def test_the_covariance_is_that_of_the_derivatives(turn: float) -> None:
    bench = ekf()
    state, p = np.array([1.0, 2.0, 0.7]), np.zeros((3, 3))
    for _ in range(8):
        v = np.array([1.0, 0.2, turn])
        bench.inputs.v, bench.inputs.gyr = v, [0.0, 0.0, turn]
        bench.step()
        state, p = predicted(state, p, v, turn)
    assert np.abs(bench.outputs.p - p).max() < 1e-9


def test_a_fix_is_weighed_by_least_squares() -> None:
    bench = ekf()
    bench.inputs.v = [1.0, 0.0, 0.5]
    bench.inputs.gyr = [0.0, 0.0, 0.5]
    bench.step(n=20)
    twin = ekf()
    twin.inputs.v, twin.inputs.gyr = [1.0, 0.0, 0.5], [0.0, 0.0, 0.5]
    twin.step(n=21)
    state, p = flat(twin.outputs.x), twin.outputs.p.copy()
    fix = state + np.array([0.1, -0.05, 0.04])
    bench.inputs.fix = pose(*fix)
    bench.step()
    r = np.diag([SIGMA["fix"] ** 2, SIGMA["fix"] ** 2, SIGMA["heading"] ** 2])
    weight = np.linalg.inv(p) + np.linalg.inv(r)
    wanted = np.linalg.solve(
        weight, np.linalg.solve(p, state) + np.linalg.solve(r, fix)
    )
    assert np.abs(flat(bench.outputs.x) - wanted).max() < 1e-9
    assert np.abs(bench.outputs.p - np.linalg.inv(weight)).max() < 1e-9
    bench.inputs.v, bench.inputs.gyr = np.zeros(3), np.zeros(3)
    before = flat(bench.outputs.x)
    bench.step()
    assert flat(bench.outputs.x) == pytest.approx(before), "a fix counts once"


def test_a_fix_across_half_a_turn_is_near() -> None:
    bench = ekf((0.0, 0.0, math.pi - 0.01))
    bench.step(n=20)
    bench.inputs.fix = pose(0.0, 0.0, -math.pi + 0.01)
    bench.step()
    assert abs(math.remainder(flat(bench.outputs.x)[2] - math.pi, 2 * math.pi)) < 0.02


@pytest.mark.parametrize("how", ["far", "nan", "no rotation", "stale"])
def test_a_wrong_fix_is_left_out(how: str) -> None:
    bench = ekf()
    bench.step(n=5)
    fix = pose(1.1, 2.0, 0.7)
    if how == "far":
        fix = pose(30.0, 2.0, 0.7)
    elif how == "stale":
        bench.stale.add("fix")
    else:
        fix[0, 0] = math.nan if how == "nan" else 3.0
    bench.inputs.fix = fix
    bench.step(n=3)
    assert np.abs(bench.outputs.x - pose(1.0, 2.0, 0.7)).max() < 1e-12
    far = [one.text for one in bench.notices() if "X_FIX" in one.text]
    assert len(far) == (how == "far")


@pytest.mark.parametrize("how", ["nan", "stale"])
def test_without_a_gyroscope_the_wheels_say_how_it_turns(how: str) -> None:
    bench = ekf()
    bench.inputs.v = [0.0, 0.0, 1.0]
    bench.inputs.gyr = [0.0, 0.0, math.nan if how == "nan" else 7.0]
    if how == "stale":
        bench.stale.add("gyr")
    bench.step(n=4)
    assert flat(bench.outputs.x)[2] == pytest.approx(0.7 + 4 * DT, abs=1e-9)


def test_wheels_that_give_no_number_are_an_error() -> None:
    bench = ekf()
    bench.inputs.v = [math.nan, 0.0, 0.0]
    with pytest.raises(MethodError, match="not a finite number"):
        bench.step()
    bench.clear()
    bench.inputs.v = [0.0, 0.0, 0.0]
    bench.on()
    assert bench.step() is State.ON
    assert bench.outputs.x == pytest.approx(pose(1.0, 2.0, 0.7))
