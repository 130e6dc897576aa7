"""Model predictive control, on a bench and against other computations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.modules.controllers.lqr import Lqr
from pbonet.modules.controllers.mpc_linear import MpcLinear
from pbonet.testing import Bench

optimize = pytest.importorskip("scipy.optimize", reason="pip install 'pbonet[mpc]'")
linalg = pytest.importorskip("scipy.linalg", reason="pip install 'pbonet[mpc]'")
pytest.importorskip("daqp", reason="pip install 'pbonet[mpc]'")

MASS = {"a": (0.0, 1.0, 0.0, 0.0), "b": (0.0, 1.0), "q": (100.0, 1.0), "r": (1.0,)}
LIMITS = {"lower": (-20.0,), "upper": (20.0,), "rate": (400.0,)}
WIDE = {"lower": (-1e6,), "upper": (1e6,), "rate": (1e9,)}
DT = 0.005


def drawn(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng([seed, *shape]).normal(size=shape)


def mpc(cls: type = MpcLinear, n: int = 2, m: int = 1, **values: Any) -> Bench[Any]:
    params = {**MASS, **LIMITS, **values.pop("params", {})}
    if cls is Lqr:
        params = {key: params[key] for key in ("a", "b", "q", "r", "lower", "upper")}
    bench = Bench(cls, params=params, freq=1 / DT, n=n, m=m, **values)
    bench.on()
    bench.step()
    return bench


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (4, 2), (12, 4)])
def test_without_limits_it_is_lqr(n: int, m: int) -> None:
    plant = {
        "a": tuple(drawn(n, n, seed=9).ravel()),
        "b": tuple(drawn(n, m, seed=10).ravel()),
        "q": (1.0,),
        "r": (0.5,),
    }
    values = {"z": drawn(n, seed=11), "z_ref": drawn(n, seed=12)}
    ours = mpc(n=n, m=m, params={**plant, **WIDE, "horizon": 7}, **values)
    other = mpc(Lqr, n=n, m=m, params={**plant, **WIDE}, **values)
    ours.step()
    other.step(n=60)  # it has faded in
    assert ours.outputs.u == pytest.approx(other.outputs.u, rel=1e-9, abs=1e-9)


def expected(z: np.ndarray, before: float, horizon: int, **limits: Any) -> float:
    """Return the first command of the plan, by least distances.

    The states are simulated; the program becomes one of scipy's non-negative least
    squares (Lawson and Hanson 1974, chapter 23).
    """
    a, b = np.array([[1.0, DT], [0.0, 1.0]]), np.array([DT**2 / 2, DT])
    q, r = np.diag([100.0, 1.0]), np.eye(1)
    end = linalg.solve_discrete_are(a, b[:, None], q, r)

    def states(u: np.ndarray, state: np.ndarray) -> np.ndarray:
        rows = []
        for one in u:
            state = a @ state + b * one
            rows.append(state)
        return np.array(rows)

    weights = [*[q] * (horizon - 1), end]
    free = states(np.zeros(horizon), z)
    forced = [states(unit, np.zeros(2)) for unit in np.eye(horizon)]
    pull = np.array([
        sum(x @ w @ y for x, w, y in zip(one, weights, free, strict=True))
        for one in forced
    ])
    square = np.eye(horizon) + np.array([
        [sum(x @ w @ y for x, w, y in zip(one, weights, two, strict=True))
         for two in forced]
        for one in forced
    ])  # fmt: skip
    steps = np.eye(horizon) - np.eye(horizon, k=-1)
    first = np.eye(horizon)[0] * before
    bound = limits["rate"] * DT
    rows = [(np.eye(horizon), np.full(horizon, -20.0), np.full(horizon, 20.0))]
    rows.append((steps, first - bound, first + bound))
    if speed := limits["speed"]:
        sums = np.array(forced)[:, :, 1].T
        rows.append((sums, -speed - free[:, 1], speed - free[:, 1]))
    above = np.vstack([sign * one for one, _, _ in rows for sign in (1.0, -1.0)])
    least = np.concatenate([side for _, low, high in rows for side in (low, -high)])
    root = np.linalg.cholesky(square)
    matrix = linalg.solve_triangular(root, above.T, lower=True).T
    least = least + above @ np.linalg.solve(square, pull)
    both = np.vstack((matrix.T, least))
    found, _ = optimize.nnls(both, np.eye(horizon + 1)[-1])
    rest = both @ found - np.eye(horizon + 1)[-1]
    away = -rest[:-1] / rest[-1]
    plan = linalg.solve_triangular(root.T, away) - np.linalg.solve(square, pull)
    return float(plan[0])


@pytest.mark.parametrize(
    ("z", "before", "params", "speed"),
    [
        ([-0.1, 0.0], 0.5, {}, None),
        ([-3.0, 0.0], 19.5, {}, None),
        ([-3.0, 0.0], 0.0, {"rate": (100.0,)}, None),
        ([-3.0, 0.4], 1.5, {"z_lower": (-9.0, -0.5), "z_upper": (9.0, 0.5)}, 0.5),
    ],
    ids=["no limit", "largest command", "rate", "speed of the mass"],
)
def test_within_limits_it_is_the_least_cost(z, before, params, speed) -> None:
    bench = mpc(z=z, u=[before], params={**params, "horizon": 12})
    assert bench.outputs.u == pytest.approx([before], abs=1e-12), "the first cycle"
    bench.step()
    told = {"speed": speed, "rate": params.get("rate", (400.0,))[0]}
    wanted = expected(np.array(z), before, 12, **told)
    assert bench.outputs.u == pytest.approx([wanted], abs=1e-7)
    assert bench.notices() == []


def move(
    bench: Bench[Any], cycles: int, state: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the states and commands of a mass that moves as it is told."""
    states, commands = [state], [float(bench.outputs.u[0])]
    for _ in range(cycles):
        bench.inputs.z = states[-1]
        bench.step()
        commands.append(u := float(bench.outputs.u[0]))
        place, speed = states[-1]
        place += DT * speed + DT**2 / 2 * u
        states.append(np.array([place, speed + DT * u]))
    return np.array(states), np.array(commands)


def test_it_brings_the_mass_to_its_place_within_all_limits() -> None:
    params = {"z_lower": (-9.0, -0.5), "z_upper": (9.0, 0.5), "rate": (100.0,)}
    bench = mpc(z_ref=[1.0, 0.0], params=params)
    states, commands = move(bench, 2000, np.zeros(2))
    assert states[-1] == pytest.approx([1.0, 0.0], abs=1e-3)
    assert states[:, 1].max() == pytest.approx(0.5, abs=1e-6), "it uses what it may"
    assert np.abs(np.diff(commands)).max() <= 100.0 * DT + 1e-8
    assert bench.notices() == []


def test_a_command_beyond_its_limits_returns_at_its_rate() -> None:
    bench = mpc(u=[25.0], z=[-9.0, 0.0])
    assert bench.outputs.u == pytest.approx([25.0], abs=1e-12)
    bench.step()
    assert bench.outputs.u == pytest.approx([23.0], abs=1e-7)
    bench.step(n=3)
    assert bench.outputs.u == pytest.approx([20.0], abs=1e-7)


FAST = {"z_lower": (-9.0, -0.5), "z_upper": (9.0, 0.5)}


@pytest.mark.parametrize(
    ("knock", "rate"), [(0.15, 400.0), (0.15, 100.0), (2.0, 400.0)]
)
def test_after_a_knock_it_returns_within_its_limits(knock, rate) -> None:
    """It brakes as hard as LOWER and RATE let it, and then goes on to its place."""
    bench = mpc(z_ref=[1.0, 0.0], params={**FAST, "rate": (rate,)})
    states, _ = move(bench, 60, np.zeros(2))
    assert states[-1, 1] == pytest.approx(0.5, abs=1e-6)
    assert bench.notices() == []
    states, commands = move(bench, 1500, states[-1] + [0.0, knock])
    speeds = states[:, 1]
    outside = np.flatnonzero(speeds > 0.5 + 1e-6)
    assert (np.diff(speeds)[outside] < 0.0).all(), "it brakes all the while"
    full, most = commands[0], speeds[0]
    for cycle in range(len(outside) // 2):
        full = max(full - rate * DT, -20.0)
        assert commands[cycle + 1] == pytest.approx(full, abs=1e-6), "as it can"
    assert len(outside) == outside[-1] + 1 < 80, "once, and not again"
    assert speeds.min() >= -0.5 - 1e-6
    assert commands.min() >= -20.0 - 1e-6
    assert np.abs(np.diff(commands)).max() <= rate * DT + 1e-6
    assert states[-1] == pytest.approx([1.0, 0.0], abs=1e-3)
    (notice,) = bench.notices()
    wanted = f"after 1 cycle it is {most - rate * DT**2:g} at best"
    assert "no command keeps Z[1] within -0.5 to 0.5" in notice.text
    assert wanted in notice.text
    assert bench.state is State.ON


def test_each_time_the_limits_cannot_be_kept_it_says_so() -> None:
    bench = mpc(u=[3.0], params=FAST)
    for _ in range(2):
        bench.inputs.z = [0.0, 0.7]
        bench.step(n=5)
        assert len(bench.notices()) == 1
        bench.inputs.z = [0.0, 0.0]
        bench.step(n=50)


def fails(bench: Bench[Any], text: str) -> None:
    """See a task end in ERROR, its command as it was."""
    before = bench.outputs.u.copy()
    with pytest.raises(MethodError, match=text):
        bench.step()
    assert bench.state is State.ERROR
    assert bench.outputs.u == pytest.approx(before, abs=1e-12)


def test_without_a_plan_the_task_ends_where_that_is_declared() -> None:
    bench = mpc(u=[3.0], z=[0.0, 0.7], params={**FAST, "infeasible": "error"})
    fails(bench, r"no command keeps Z\[1\] within -0.5 to 0.5: after 20 cycles it is 1")


def test_a_plan_that_is_not_found_in_time_is_none() -> None:
    bench = mpc(u=[1.0], z=[-3.0, 0.45], params={**FAST, "iterations": 1})
    fails(bench, "no plan was found in 1 steps: ITERATIONS")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_state_that_is_no_number_is_named(bad) -> None:
    bench = mpc(u=[1.0], z=[0.1, bad])
    fails(bench, r"Z_MEZ\[1\] is not finite")


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"lower": (20.0,)}, "the limits leave no room"),
        ({"z_lower": (1.0, 2.0), "z_upper": (1.0, 3.0)}, "limits of the state leave"),
        ({"a": (1.0,)}, "4: 2 rows of 2"),
        ({"b": (0.0, 0.0)}, "no gain stabilizes this plant"),
    ],
)
def test_what_is_no_plan_is_refused(params, text) -> None:
    with pytest.raises(MethodError, match=text):
        mpc(params=params)


def test_a_weight_is_set_while_it_is_on() -> None:
    bench, other = mpc(z=[0.1, 0.0]), mpc(z=[0.1, 0.0], params={"r": (5.0,)})
    bench.step()
    bench.set("r", "5")
    other.step()
    bench.step()
    other.step()
    assert bench.outputs.u == pytest.approx(other.outputs.u, abs=1e-9)
