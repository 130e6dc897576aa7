"""Filters and limits, against scipy and closed forms, on a bench."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from pbonet import State
from pbonet.errors import MethodError
from pbonet.modules.signals.biquad import Biquad
from pbonet.modules.signals.limits import Limits
from pbonet.modules.signals.median import Median
from pbonet.testing import Bench

SIZES = [1, 2, 7, 30]


def run(bench: Bench, rows: np.ndarray) -> np.ndarray:
    """Return the outputs y for the inputs z."""
    seen = []
    for row in rows:
        bench.inputs.z = row
        bench.step()
        seen.append(bench.outputs.y.copy())
    return np.array(seen)


# ----------------------------------------------------------------------------- biquad


def analogue(kind: str, freq: float, q: float, rate: float):
    """Return the filter by scipy's bilinear transform of its analogue prototype."""
    w = 2.0 * rate * math.tan(math.pi * freq / rate)
    top = {"low": [w * w], "high": [1.0, 0.0, 0.0], "notch": [1.0, 0.0, w * w]}[kind]
    return signal.bilinear(top, [1.0, w / q, w * w], rate)


def biquad(kind: str, n: int, freq=40.0, q=0.9, rate=500.0, **more) -> Bench[Biquad]:
    begin = more.pop("begin", "output")
    params = {"kind": kind, "frequency": freq, "q": q, "begin": begin}
    bench = Bench(Biquad, params=params, ndof=n, freq=rate, **more)
    bench.on()
    return bench


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("kind", ["low", "high", "notch"])
def test_biquad_filters_as_scipy_does(kind: str, n: int) -> None:
    rng = np.random.default_rng(n)
    z0, y0, rows = rng.normal(size=n), rng.normal(size=n), rng.normal(size=(80, n))
    bench = biquad(kind, n, z=z0, y=y0)
    assert np.array_equal(bench.outputs.y, y0), "bumpless"
    b, a = analogue(kind, 40.0, 0.9, 500.0)
    for k, got in enumerate(run(bench, rows).T):
        state = signal.lfiltic(b, a, [y0[k]] * 2, [z0[k]] * 2)
        wanted, _ = signal.lfilter(b, a, rows[:, k], zi=state)
        assert np.abs(got - wanted).max() < 1e-9


def test_biquad_is_butterworths_by_default() -> None:
    bench = Bench(Biquad, params={"kind": "low", "frequency": 40.0}, ndof=1, freq=500)
    bench.on()
    got = run(bench, np.ones((60, 1)))[:, 0]
    b, a = signal.butter(2, 40.0, fs=500.0)
    wanted, _ = signal.lfilter(b, a, np.ones(60), zi=[0.0, 0.0])
    assert np.abs(got - wanted).max() < 1e-9


@pytest.mark.parametrize(("kind", "y"), [("low", 3.0), ("high", 0.0), ("notch", 3.0)])
def test_biquad_may_begin_settled_at_the_input(kind: str, y: float) -> None:
    bench = biquad(kind, 1, z=[3.0], y=[7.0], begin="input")
    assert bench.outputs.y[0] == y
    assert run(bench, np.full((50, 1), 3.0)) == pytest.approx(y, abs=1e-9)


def test_biquad_removes_one_frequency_and_keeps_the_rest() -> None:
    t = np.arange(600) / 500.0
    for freq, size in ((40.0, 0.0), (5.0, 1.0)):
        bench = biquad("notch", 1)
        rows = np.sin(2 * np.pi * freq * t)[:, None]
        assert np.abs(run(bench, rows)[300:]).max() == pytest.approx(size, abs=1e-2)


def test_biquad_follows_the_frequency_of_the_task() -> None:
    bench = biquad("low", 1)
    bench.task.freq = 250.0
    b, a = analogue("low", 40.0, 0.9, 250.0)
    wanted = signal.lfilter(b, a, np.ones(30))
    assert run(bench, np.ones((30, 1)))[:, 0] == pytest.approx(wanted, abs=1e-9)


def test_biquad_refuses_what_the_task_cannot_filter() -> None:
    with pytest.raises(MethodError, match="FREQUENCY below 250 Hz, half the task's"):
        biquad("low", 1, freq=250.0)
    bench = biquad("low", 1)
    with pytest.raises(MethodError, match="the old value of frequency remains"):
        bench.set("frequency", 300.0)


@pytest.mark.parametrize("kind", ["low", "high", "notch"])
def test_biquad_recovers_from_a_value_that_is_not_finite(kind: str) -> None:
    bench = biquad(kind, 2, z=[1.0, 1.0])
    run(bench, np.ones((5, 2)))
    before = bench.outputs.y.copy()
    with pytest.raises(MethodError, match=r"not a finite number: Y\[1\]"):
        run(bench, np.array([[1.0, math.nan]]))
    assert np.array_equal(bench.outputs.y, before)
    bench.clear()
    bench.inputs.z = [1.0, 1.0]
    bench.on()
    assert np.isfinite(run(bench, np.ones((5, 2)))).all()


# ----------------------------------------------------------------------------- median


def median(n: int, length: int, **more) -> Bench[Median]:
    params = {"length": length, "begin": more.pop("begin", "output")}
    bench = Bench(Median, params=params, ndof=n, freq=500, **more)
    bench.on()
    return bench


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("length", [1, 3, 9])
def test_median_is_that_of_scipy(n: int, length: int) -> None:
    rng = np.random.default_rng(n)
    y0, rows = rng.normal(size=n), rng.normal(size=(50, n))
    bench = median(n, length, y=y0)
    assert np.array_equal(bench.outputs.y, y0), "bumpless"
    padded = np.vstack((np.tile(y0, (length, 1)), rows))
    late = length // 2
    for k, got in enumerate(run(bench, rows).T):
        wanted = signal.medfilt(padded[:, k], length)[
            length - late : len(padded) - late
        ]
        assert np.array_equal(got[: len(wanted)], wanted[:50])


@pytest.mark.parametrize("spike", [1e6, -1e6, math.nan, math.inf])
def test_median_does_not_see_a_single_wrong_sample(spike: float) -> None:
    bench = median(2, 3, begin="input", z=[1.0, 2.0])
    rows = np.tile([1.0, 2.0], (9, 1))
    rows[4, 0] = spike
    assert np.array_equal(run(bench, rows), np.tile([1.0, 2.0], (9, 1)))
    with pytest.raises(MethodError, match=r"not a finite number: Y\[0\]"):
        run(bench, np.full((3, 2), math.nan))


def test_median_takes_odd_lengths_only() -> None:
    bench = median(1, 3)
    with pytest.raises(MethodError, match="take 5"):
        bench.set("length", 4)
    bench.set("length", 5)
    assert run(bench, np.ones((5, 1)))[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0]


# ----------------------------------------------------------------------------- limits

DT = 0.01


def limits(n: int = 1, y=None, z=None, **params) -> Bench[Limits]:
    given = {name: np.atleast_1d(value) for name, value in params.items()}
    y = np.zeros(n) if y is None else y
    bench = Bench(
        Limits, params=given, ndof=n, freq=1 / DT, y=y, z=y if z is None else z
    )
    bench.on()
    return bench


@pytest.mark.parametrize("n", SIZES)
def test_limits_reach_a_step_on_a_trapezoid(n: int) -> None:
    """Five cycles of growing speed, ten at the limit, five of falling: closed form."""
    a, top = 2.0, 5 * 2.0 * DT
    steps = DT * np.array([*range(1, 6), *[5] * 10, *range(4, 0, -1)]) * a * DT
    start, sign = np.linspace(-1, 1, n), (-1.0) ** np.arange(n)
    bench = limits(n, y=start, velocity=top, acceleration=a)
    goal = start + sign * steps.sum()
    wanted = start + np.cumsum(steps)[:, None] * sign
    got = run(bench, np.tile(goal, (40, 1)))
    assert np.abs(got[:19] - wanted).max() < 1e-9
    assert np.abs(got[19:] - goal).max() < 1e-9


def test_limits_follow_what_keeps_them_without_a_lag() -> None:
    bench = limits(velocity=1.0, acceleration=2.0, lower=-1.0, upper=1.0)
    t = DT * np.arange(1, 600)
    wave = 0.4 * (1.0 - np.cos(1.5 * t))[:, None]
    assert np.abs(run(bench, wave) - wave)[100:].max() < 1e-9


@pytest.mark.parametrize("n", SIZES)
def test_limits_hold_for_any_input(n: int) -> None:
    rng = np.random.default_rng(n)
    low, high = -rng.uniform(0.2, 1, n), rng.uniform(0.2, 1, n)
    v, a = rng.uniform(0.3, 2, n), rng.uniform(1, 9, n)
    bench = limits(n, lower=low, upper=high, velocity=v, acceleration=a)
    rows = np.repeat(rng.normal(size=(60, n)), 10, axis=0)
    rows += rng.normal(scale=0.01, size=rows.shape)
    y = np.vstack((np.zeros(n), run(bench, rows)))
    speed = np.vstack((np.zeros(n), np.diff(y, axis=0) / DT))
    assert (y >= low).all()
    assert (y <= high).all()
    assert (np.abs(speed) <= v + 1e-9).all()
    assert (np.abs(np.diff(speed, axis=0)) <= a * DT + 1e-9).all()


def test_limits_stop_softly_at_an_end_and_stay_there() -> None:
    bench = limits(upper=0.5, velocity=1.0, acceleration=2.0)
    ramp = (DT * np.arange(1, 200))[:, None]
    y = run(bench, ramp)[:, 0]
    assert np.abs(np.diff(y, n=2)).max() <= 2.0 * DT * DT + 1e-12
    assert y.max() == pytest.approx(0.5, abs=1e-9)
    assert y[-1] == pytest.approx(0.5, abs=1e-9)


def test_limits_let_a_value_beyond_a_limit_come_back_only() -> None:
    bench = limits(y=[0.9], z=[2.0], upper=0.5, velocity=1.0)
    assert bench.outputs.y.tolist() == [0.9], "bumpless"
    y = run(bench, np.array([[2.0]] * 60))[:, 0]
    assert y[0] <= 0.9
    assert (np.diff(y) <= 0.0).all()
    assert y[-1] == pytest.approx(0.5)


def test_limits_without_any_pass_everything() -> None:
    rows = np.random.default_rng(1).normal(size=(20, 3))
    assert run(limits(3), rows) == pytest.approx(rows, abs=1e-9)


@pytest.mark.parametrize(("z", "y"), [(math.inf, 0.5), (-math.inf, -0.5)])
def test_limits_take_an_infinite_value_for_a_far_one(z: float, y: float) -> None:
    bench = limits(lower=-0.5, upper=0.5, velocity=10.0)
    assert run(bench, np.full((20, 1), z))[-1, 0] == pytest.approx(y)


def test_limits_end_in_error_when_there_is_no_number() -> None:
    bench = limits(velocity=1.0)
    with pytest.raises(MethodError, match=r"not a finite number: Y\[0\]"):
        run(bench, np.array([[math.nan]]))
    assert bench.state is State.ERROR
    bench.clear()
    bench.inputs.z = [0.0]
    bench.on()
    assert run(bench, np.array([[0.005]]))[0, 0] == pytest.approx(0.005)


def test_limits_refuse_bounds_without_room() -> None:
    with pytest.raises(MethodError, match="LOWER at most UPPER"):
        limits(lower=1.0, upper=-1.0)
