"""A motion that was shown once, on a bench and against scipy."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from pbonet import Signal, State
from pbonet.errors import MethodError
from pbonet.modules.trajectories.dmp import Dmp
from pbonet.testing import Bench

if TYPE_CHECKING:
    from pathlib import Path

signal = pytest.importorskip("scipy.signal")
DT, LASTS, WAY = 0.004, 1.6, np.array([0.8, -0.5])


def motion(time: np.ndarray) -> np.ndarray:
    """Return the least jerk from rest to rest, with a wave on its way."""
    s = time[:, None] / LASTS
    wave = 0.1 * np.sin(np.pi * s) ** 4
    return WAY * s**3 * (10.0 - 15.0 * s + 6.0 * s * s) + wave


@pytest.fixture
def shown(tmp_path: Path) -> Path:
    time = np.linspace(0.0, LASTS, 401)
    file = tmp_path / "shown.csv"
    np.savetxt(file, np.column_stack((time, motion(time))))
    return file


def dmp(file: Path, n: int = 2, **values: Any) -> Bench[Dmp]:
    params = {"file": file.name, **values.pop("params", {})}
    given = {"ndof": n, "library": [file.parent], **values}
    bench = Bench(Dmp, params=params, freq=1.0 / DT, **given)
    bench.on(handover="y_dot" in values)
    return bench


def run(bench: Bench[Dmp], cycles: int) -> np.ndarray:
    rows = []
    for _ in range(cycles):
        bench.step()
        rows.append(bench.outputs.y.copy())
    return np.array(rows)


def test_it_makes_the_motion_that_was_shown(shown) -> None:
    bench = dmp(shown, y_des=WAY)
    count = round(LASTS / DT)
    seen = run(bench, count)
    wanted = motion(DT * np.arange(1, count + 1))
    assert np.abs(seen - wanted).max() < 0.01
    assert [notice.bits for notice in bench.notices()] == [Signal.FINISH]
    assert run(bench, count)[-1] == pytest.approx(WAY, abs=1e-5)


def test_it_is_the_spring_of_scipy_under_the_force_of_its_bumps(shown) -> None:
    """Another start, goal and duration, and a velocity when it is turned on."""
    start, speed, goal = np.array([0.3, 0.2]), np.array([0.1, -0.4]), [1.5, 0.4]
    params = {"duration": 2.4, "stiffness": 225.0, "count": 12}
    values = {"y": start, "y_dot": speed, "y_des": goal}
    bench = dmp(shown, params=params, **values)
    seen = run(bench, 700)
    lasts, k = 2.4, 225.0
    a = np.array([[0.0, 1.0], [-k / lasts**2, -2.0 * math.sqrt(k) / lasts]])
    b = np.array([[0.0], [k / lasts**2]])
    step, push, *_ = signal.cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), DT)
    state, expected = np.array([start, speed]), []
    centers = [math.exp(-4.6 * i / 11) for i in range(12)]
    gaps = [two - one for one, two in itertools.pairwise(centers)]
    gaps.append(gaps[-1])
    for cycle in range(700):
        x = math.exp(-4.6 * DT * cycle / lasts)
        heights = [
            math.exp(-(((x - c) / gap) ** 2))
            for c, gap in zip(centers, gaps, strict=True)
        ]
        force = sum(
            h * w for h, w in zip(heights, bench.module._weights, strict=True)
        ) * (x / sum(heights))
        drawn = np.array(goal) - (np.array(goal) - start) * x + force
        state = step @ state + push * drawn
        expected.append(state[0])
    assert seen == pytest.approx(np.array(expected), abs=1e-9)
    assert bench.outputs.y_dot == pytest.approx(state[1], abs=1e-9)
    assert seen[0] == pytest.approx(start + DT * speed, abs=1e-3), "no jump"


def test_a_new_goal_bends_the_motion_without_a_jump(shown) -> None:
    bench = dmp(shown, y_des=WAY)
    before = run(bench, 150)
    speed = bench.outputs.y_dot.copy()
    bench.inputs.y_des = [-1.0, 2.0]
    after = run(bench, 1200)
    assert after[0] - before[-1] == pytest.approx(DT * speed, abs=0.01)
    steps = np.diff(np.vstack((before, after)), axis=0)
    assert np.abs(np.diff(steps, axis=0)).max() < 0.01
    assert after[-1] == pytest.approx([-1.0, 2.0], abs=1e-6)


def test_without_a_goal_it_comes_to_rest_and_says_so_once(shown) -> None:
    nothing = [math.nan, 0.0]
    bench = dmp(shown, y=[0.5, 0.5], y_dot=[0.2, 0.0], y_des=nothing)
    seen = run(bench, 1500)
    assert seen[0] == pytest.approx([0.5 + 0.2 * DT, 0.5], abs=1e-4)
    assert seen[-1] == pytest.approx([0.5, 0.5], abs=1e-6)
    (notice,) = bench.notices()
    assert "Y_DES[0] is not finite" in notice.text
    bench.inputs.y_des = [0.7, 0.1]
    assert run(bench, 1500)[-1] == pytest.approx([0.7, 0.1], abs=1e-6)
    bench.inputs.y_des = nothing
    assert run(bench, 50)[-1] == pytest.approx([0.7, 0.1], abs=1e-6), "the last one"
    assert bench.state is State.ON


@pytest.mark.parametrize("count", [150, 200])
def test_it_stays_at_its_goal_after_the_motion(shown, count) -> None:
    """The phase is then far from all bumps, which are narrow when there are many."""
    params = {"duration": 1.0, "count": count}
    bench = dmp(shown, y_des=WAY, params=params)
    seen = run(bench, round(3.0 / DT))
    assert np.isfinite(seen).all()
    assert seen[-1] == pytest.approx(WAY, abs=1e-5)
    assert bench.outputs.y_dot == pytest.approx(0.0, abs=1e-4)
    assert bench.state is State.ON


def test_a_new_duration_counts_from_the_next_on(shown) -> None:
    bench = dmp(shown, y_des=WAY)
    same = dmp(shown, y_des=WAY)
    bench.step(n=100)
    bench.set("duration", "0.4")
    seen = run(bench, 100)
    same.step(n=100)
    assert seen == pytest.approx(run(same, 100), abs=1e-12)
    bench.off()
    bench.outputs.y = [0.0, 0.0]
    bench.on()
    assert run(bench, 110)[-1] == pytest.approx(WAY, abs=0.02)


def test_what_shapes_the_motion_is_read_once(shown) -> None:
    bench = dmp(shown)
    with pytest.raises(MethodError, match="count is read when the task is created"):
        bench.set("count", "5")
    bench.off()
    assert not bench.outputs.y_dot.any()
