"""The trajectory generators, each against a closed form or scipy, on a bench."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from pbonet import Signal, State
from pbonet.errors import MethodError
from pbonet.io.sample_file import read_samples
from pbonet.modules.trajectories.otg import Otg
from pbonet.modules.trajectories.otg_cart import OtgCart
from pbonet.modules.trajectories.spline import Spline
from pbonet.modules.trajectories.traj_play import TrajPlay
from pbonet.outside import Player, Tape, files_read, use
from pbonet.testing import Bench

SIZES = [1, 2, 7, 30]
LIMITS = {"velocity": (1.0,), "acceleration": (2.0,), "jerk": (8.0,)}
STEP = 0.002


def said(bench: Bench) -> list[str]:
    """Return the names of signals and the texts of warnings."""
    names = {Otg.REACHED: "REACHED", Signal.FINISH: "FINISH"}
    return [names.get(notice.bits, notice.text) for notice in bench.notices()]


def s_curve(way: float, v: float, a: float, j: float, times: np.ndarray) -> np.ndarray:
    """Return position, velocity, acceleration of the fastest way from rest to rest.

    Seven pieces of constant jerk, where velocity and acceleration reach their limits.
    """
    ramp, flat = a / j, v / a - a / j
    cruise = way / v - v / a - a / j
    assert flat >= 0.0
    assert cruise >= 0.0
    lasts = [ramp, flat, ramp, cruise, ramp, flat, ramp]
    jerks = [j, 0.0, -j, 0.0, -j, 0.0, j]
    ends = np.cumsum(lasts)
    starts = [(0.0, 0.0, 0.0)]
    for t, jerk in zip(lasts, jerks, strict=True):
        starts.append(piece(*starts[-1], jerk, t))
    rows = []
    for time in times:
        k = int(np.searchsorted(ends, time))
        if k == len(lasts):
            rows.append((way, 0.0, 0.0))
        else:
            rows.append(piece(*starts[k], jerks[k], time - (ends[k] - lasts[k])))
    return np.array(rows)


def piece(p: float, v: float, a: float, j: float, t: float) -> tuple[float, ...]:
    return p + v * t + a * t**2 / 2 + j * t**3 / 6, v + a * t + j * t**2 / 2, a + j * t


def otg(n: int = 2, **more) -> Bench[Otg]:
    bench = Bench(Otg, params=LIMITS, ndof=n, freq=1 / STEP, **more)
    bench.on(handover=True)
    return bench


# -------------------------------------------------------------------------------- otg


@pytest.mark.parametrize("n", SIZES)
def test_otg_goes_the_fastest_way(n: int) -> None:
    """All ways are as long, so that each joint goes as if it were alone."""
    start = np.linspace(-1.0, 1.0, n)
    way = 1.5 * (-1.0) ** np.arange(n)
    bench = otg(n, q=start, q_des=start + way)
    times = STEP * np.arange(1, 1400)
    wanted = s_curve(1.5, 1.0, 2.0, 8.0, times)
    assert 2.0 < 1.5 + 1.0 / 2.0 + 2.0 / 8.0 < times[-1], "it arrives"
    for row in wanted:
        bench.step()
        out = bench.outputs
        got = np.array([(out.q - start) / way, out.q_dot / way, out.q_acc / way])
        assert np.abs(1.5 * got - row[:, None]).max() < 1e-9
    assert said(bench) == ["REACHED"]


def test_otg_is_at_the_right_place_after_cycles_that_were_missed() -> None:
    bench = otg(1, q_des=[1.5])
    for time in np.cumsum([STEP, 5 * STEP, STEP, 0.3, 0.7, STEP]):
        bench.step(time - bench.task.now * 1e-9 + begin(bench))
        assert bench.outputs.q[0] == pytest.approx(
            s_curve(1.5, 1.0, 2.0, 8.0, [time])[0, 0], abs=1e-8
        )


def begin(bench: Bench) -> float:
    return bench.__dict__.setdefault("begin", bench.task.now * 1e-9)


def test_otg_keeps_the_limits_whatever_the_goals_are() -> None:
    rng = np.random.default_rng(15)
    bench = otg(3)
    before = np.zeros((3, 3))
    for k in range(1500):
        if k % 100 == 0:
            bench.inputs.q_des = rng.uniform(-2.0, 2.0, 3)
        bench.step()
        out = bench.outputs
        state = np.array([out.q, out.q_dot, out.q_acc])
        assert np.abs(state[1]).max() < 1.0 + 1e-9
        assert np.abs(state[2]).max() < 2.0 + 1e-9
        assert np.abs(state[2] - before[2]).max() < 8.0 * STEP + 1e-9
        mean = (state[1] + before[1]) / 2
        assert state[0] - before[0] == pytest.approx(mean * STEP, abs=8 * STEP**3)
        before = state


@pytest.mark.parametrize("n", SIZES)
def test_otg_takes_over_a_motion_without_a_jump(n: int) -> None:
    q, v, a = np.linspace(1, 2, n), np.linspace(-0.5, 0.5, n), np.linspace(1, 0, n)
    bench = otg(n, q=q, q_dot=v, q_acc=a)
    out = bench.outputs
    assert np.array_equal([out.q, out.q_dot, out.q_acc], [q, v, a])
    bench.step()
    assert np.abs(out.q - q - v * STEP - a * STEP**2 / 2).max() < 8 * STEP**3
    assert np.abs(out.q_dot - v - a * STEP).max() <= 8 * STEP**2


def test_otg_reduces_a_velocity_that_is_above_the_limit() -> None:
    bench = otg(1, q_dot=[1.8], q_des=[9.0])
    bench.step()
    assert bench.outputs.q_dot[0] == pytest.approx(1.8, abs=1e-3)
    bench.step(n=700)
    assert bench.outputs.q_dot[0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("start", "goal", "limits"),
    [
        (0.48, 0.50, (0.25, 1.0, 10.0)),
        (-0.76, -0.75, (2.0, 2.0, 40.0)),
    ],
)
def test_otg_finds_a_way_on_which_a_phase_has_no_length(start, goal, limits) -> None:
    """Of 2 a^3 / j^2: the largest acceleration is reached, and left at once."""
    names = ("velocity", "acceleration", "jerk")
    params = {name: (one,) for name, one in zip(names, limits, strict=True)}
    bench = Bench(Otg, params=params, ndof=1, q=[start], q_des=[goal], freq=1 / STEP)
    bench.on()
    bench.step(n=round(0.6 / STEP))
    assert bench.outputs.q[0] == pytest.approx(goal, abs=1e-9)
    assert said(bench) == ["REACHED"]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_otg_brakes_without_a_goal_and_goes_on_with_one(bad: float) -> None:
    bench = otg(2, q_des=[3.0, -3.0])
    bench.step(n=400)
    fast = bench.outputs.q_dot.copy()
    bench.inputs.q_des = [3.0, bad]
    bench.step()
    assert np.abs(bench.outputs.q_dot - fast).max() < 2.0 * STEP
    bench.step(n=600)
    assert bench.outputs.q_dot.tolist() == [0.0, 0.0]
    assert said(bench) == ["Q_DES of joint 2 is not finite: the joints brake"]
    bench.inputs.q_des = [3.0, -3.0]
    bench.step(n=2000)
    assert bench.outputs.q == pytest.approx([3.0, -3.0], abs=1e-9)
    assert said(bench) == ["REACHED"]


def test_otg_brakes_when_the_configuration_is_illegal() -> None:
    bench = otg(1, q_des=[3.0], critical=True)
    bench.step(n=400)
    assert bench.outputs.q_dot[0] > 0.9
    bench.illegal = True
    bench.step(n=600)
    assert bench.outputs.q_dot[0] == 0.0
    bench.illegal = False
    bench.step(n=2500)
    assert bench.outputs.q[0] == pytest.approx(3.0, abs=1e-9)


def test_otg_slows_down_when_the_limit_does() -> None:
    bench = otg(1, q_des=[9.0])
    bench.step(n=1000)
    bench.set("velocity", 0.4)
    bench.step(n=800)
    assert bench.outputs.q_dot[0] == pytest.approx(0.4, abs=1e-9)


def test_otg_says_rest_when_it_is_turned_off_but_not_to_a_successor() -> None:
    for handover in (False, True):
        bench = otg(1, q_des=[9.0])
        bench.step(n=500)
        q, v = bench.outputs.q[0], bench.outputs.q_dot[0]
        bench.off(handover=handover)
        assert bench.outputs.q[0] == q
        assert bench.outputs.q_dot[0] == (v if handover else 0.0)


def test_otg_says_why_it_finds_no_trajectory() -> None:
    bench = otg(1, q_des=[1e300])
    with pytest.raises(MethodError, match="ruckig finds no trajectory"):
        bench.step()
    assert bench.outputs.q.tolist() == [0.0]


def test_otg_refuses_limits_of_another_size() -> None:
    with pytest.raises(MethodError, match="parameter jerk has the wrong number"):
        otg(3).set("jerk", (1.0, 2.0))


def test_otg_names_the_package_that_is_missing(monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ruckig", None)
    with pytest.raises(MethodError, match=r"pip install 'pbonet\[trajectory\]'"):
        Bench(Otg, params=LIMITS, ndof=1)


# --------------------------------------------------------------------------- otg_cart

POSE = np.hstack((np.eye(3), [[0.1], [0.2], [0.3]]))
CART = {
    "velocity": 1.0, "acceleration": 2.0, "jerk": 8.0,
    "turn": 1.0, "turn_acceleration": 2.0, "turn_jerk": 8.0,
}  # fmt: skip


def pose(x, turn) -> np.ndarray:
    return np.hstack((Rotation.from_rotvec(turn).as_matrix(), np.reshape(x, (3, 1))))


def otg_cart(x=POSE, **more) -> Bench[OtgCart]:
    bench = Bench(OtgCart, params=CART, x=x, freq=1 / STEP, **more)
    bench.on(handover=True)
    return bench


@pytest.mark.parametrize(
    "axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1)], ids=["x", "y", "z"]
)
def test_otg_cart_moves_and_turns_the_fastest_way(axis) -> None:
    axis = np.array(axis, dtype=float)
    start = pose([0.1, 0.2, 0.3], [0.4, -0.3, 0.9])
    goal = pose(start[:, 3] + 1.5 * axis, [0, 0, 0])
    goal[:, :3] = Rotation.from_rotvec(1.5 * axis).as_matrix() @ start[:, :3]
    bench = otg_cart(start, x_des=goal)
    for row in s_curve(1.5, 1.0, 2.0, 8.0, STEP * np.arange(1, 1200)):
        bench.step()
        out = bench.outputs
        assert np.abs(out.x[:, 3] - start[:, 3] - row[0] * axis).max() < 1e-9
        turned = Rotation.from_rotvec(row[0] * axis).as_matrix() @ start[:, :3]
        assert np.abs(out.x[:, :3] - turned).max() < 1e-9
        assert np.abs(out.v - row[1] * np.tile(axis, 2)).max() < 1e-9
    assert said(bench) == ["REACHED"]


@pytest.mark.slow
def test_otg_cart_bends_to_new_goals_without_a_jump() -> None:
    rng = np.random.default_rng(15)
    bench = otg_cart()
    before, speed, push = bench.outputs.x.copy(), np.zeros(6), np.zeros(6)
    for k in range(1200):
        if k % 60 == 0:
            turn = rng.normal(size=3)
            turn *= rng.uniform(0.0, 3.0) / np.linalg.norm(turn)
            bench.inputs.x_des = pose(rng.uniform(-1, 1, 3), turn)
        bench.step()
        x, v = bench.outputs.x, bench.outputs.v
        change = Rotation.from_matrix(x[:, :3] @ before[:, :3].T).as_rotvec()
        moved = np.concatenate((x[:, 3] - before[:, 3], change))
        assert moved == pytest.approx((v + speed) / 2 * STEP, abs=6e-8)
        gain = (v - speed) / STEP
        assert np.abs(gain - push).max() < 30 * STEP, "no jump in acceleration"
        before, speed, push = x.copy(), v.copy(), gain
    assert np.abs(before[:, :3].T @ before[:, :3] - np.eye(3)).max() < 1e-12


def test_the_turn_has_the_velocity_and_acceleration_of_its_rotation_vector() -> None:
    """Against central differences of scipy's rotations."""
    from pbonet.modules._moving_orientation import Turning

    rng = np.random.default_rng(3)
    h = 1e-4
    for size in (1e-3, 0.09, 0.11, 1.0, 3.0):
        r, rate, push = rng.normal(size=(3, 3))
        r *= size / np.linalg.norm(r)
        base = Rotation.from_rotvec([0.3, 0.2, 0.1])
        turning = Turning(base.as_matrix(), np.zeros(3))

        def at(t: float, r=r, rate=rate, push=push, base=base) -> Rotation:
            return Rotation.from_rotvec(r + rate * t + push * t * t / 2) * base

        turning.move(r, rate, push)
        plus, minus = ((at(h) * at(0).inv()), (at(-h) * at(0).inv()))
        velocity = (plus.as_rotvec() - minus.as_rotvec()) / (2 * h)
        assert turning.velocity == pytest.approx(velocity, abs=1e-6)
        ahead, behind = (
            (at(t + h) * at(t - h).inv()).as_rotvec() / (2 * h) for t in (h, -h)
        )
        assert turning.acceleration() == pytest.approx(
            (ahead - behind) / (2 * h), abs=1e-5
        )
        assert turning.matrix == pytest.approx(at(0).as_matrix(), abs=1e-12)


def test_otg_cart_takes_over_a_motion_without_a_jump() -> None:
    start, v = pose([1, 2, 3], [0.4, 0.5, -0.6]), np.array([0.3, 0, -0.2, 0.1, 0.5, 0])
    bench = otg_cart(start, v=v, x_des=POSE)
    assert np.array_equal(bench.outputs.x, start)
    assert np.array_equal(bench.outputs.v, v)
    bench.step()
    assert bench.outputs.v == pytest.approx(v, abs=1e-4)
    assert bench.outputs.x[:, 3] == pytest.approx(start[:, 3] + v[:3] * STEP, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("bad", ["nan", "no rotation"])
def test_otg_cart_brakes_without_a_goal_and_goes_on_with_one(bad) -> None:
    goal = pose([3, 0, 0], [0, 0, 2])
    bench = otg_cart(x_des=goal)
    bench.step(n=400)
    fast = bench.outputs.v.copy()
    assert fast[0] > 0.9
    wrong = goal.copy()
    wrong[0, 0] = math.nan if bad == "nan" else 2.0
    bench.inputs.x_des = wrong
    bench.step()
    assert np.abs(bench.outputs.v - fast).max() < 2.1 * STEP
    bench.step(n=700)
    assert np.abs(bench.outputs.v).max() < 1e-12
    assert said(bench) == ["X_DES is no pose [R p]: the hand brakes"]
    bench.inputs.x_des = goal
    bench.step(n=3000)
    assert bench.outputs.x == pytest.approx(goal, abs=1e-9)


def test_otg_cart_needs_a_pose_to_start_from() -> None:
    bench = Bench(OtgCart, params=CART)
    with pytest.raises(MethodError, match="X_REF is no pose"):
        bench.on()
    assert bench.state is State.ERROR


@pytest.mark.slow
def test_otg_cart_turns_half_a_turn() -> None:
    goal = pose([0.1, 0.2, 0.3], [math.pi, 0, 0])
    bench = otg_cart(x_des=goal)
    bench.step(n=2100)
    assert bench.outputs.x == pytest.approx(goal, abs=1e-9)
    assert said(bench) == ["REACHED"]


# ----------------------------------------------------------------------------- spline

TIMES = (0.5, 0.9, 1.6, 2.0)


def spline(n: int, order: str, **more) -> tuple[Bench[Spline], np.ndarray]:
    rng = np.random.default_rng(n)
    points = rng.normal(size=(len(TIMES), n))
    params = {"time": TIMES, "points": points.ravel(), "order": order}
    bench = Bench(Spline, params=params, ndof=n, freq=100, **more)
    bench.on(handover=True)
    return bench, points


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("order", ["cubic", "quintic"])
def test_spline_is_that_of_scipy(n: int, order: str) -> None:
    rng = np.random.default_rng(7 * n)
    y, v, a = rng.normal(size=(3, n))
    bench, points = spline(n, order, y=y, y_dot=v, y_acc=a)
    assert np.array_equal(bench.outputs.y, y)
    t, rows, zero = np.array([0.0, *TIMES]), np.vstack((y, points)), np.zeros(n)
    if order == "cubic":
        wanted = CubicSpline(t, rows, bc_type=((1, v), (1, zero)))
    else:
        ends = ([(1, v), (2, a)], [(1, zero), (2, zero)])
        wanted = make_interp_spline(t, rows, k=5, bc_type=ends)
    for k in range(1, 200):
        bench.step()
        out = bench.outputs
        for got, nu in ((out.y, 0), (out.y_dot, 1), (out.y_acc, 2)):
            exact = wanted(0.01 * k, nu)
            assert np.abs(got - exact).max() < 1e-9 * max(1.0, np.abs(exact).max())


def test_spline_rests_in_the_last_point_and_says_so() -> None:
    bench, points = spline(2, "quintic")
    bench.step(n=250)
    assert bench.outputs.y.tolist() == points[-1].tolist()
    assert bench.outputs.y_dot.tolist() == bench.outputs.y_acc.tolist() == [0.0, 0.0]
    assert said(bench) == ["FINISH"]
    bench.off()
    bench.on()
    bench.step(0.5)
    assert bench.outputs.y == pytest.approx(points[0]), "again, from where it stood"


def test_spline_says_rest_when_it_is_turned_off_but_not_to_a_successor() -> None:
    for handover in (False, True):
        bench, _ = spline(1, "cubic")
        bench.step(n=30)
        y, v = bench.outputs.y[0], bench.outputs.y_dot[0]
        bench.off(handover=handover)
        assert bench.outputs.y[0] == y
        assert bench.outputs.y_dot[0] == (v if handover else 0.0)


@pytest.mark.parametrize(
    ("time", "points", "text"),
    [
        ((1.0, 1.0), (1.0, 2.0), "each one later than the one before, got 1 1"),
        ((1.0, 2.0), (1.0, 2.0, 3.0), "expected 2: 1 for each of the 2 values of TIME"),
    ],
)
def test_spline_refuses_points_that_are_no_path(time, points, text) -> None:
    with pytest.raises(MethodError, match=text):
        Bench(Spline, params={"time": time, "points": points}, ndof=1)


def test_spline_takes_one_value_for_all_elements() -> None:
    params = {"time": (1.0, 2.0), "points": (3.0, 4.0)}
    bench = Bench(Spline, params=params, ndof=3, freq=100)
    bench.on()
    bench.step(1.0)
    assert bench.outputs.y == pytest.approx([3.0] * 3)


def test_spline_takes_no_other_points_while_it_exists() -> None:
    bench, _ = spline(1, "cubic")
    with pytest.raises(MethodError, match="kill the task and spawn it again"):
        bench.set("order", "quintic")


# -------------------------------------------------------------------------- traj_play


def recorded(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    time = 3.0 + np.cumsum(rng.uniform(0.02, 0.3, 12))
    return time, rng.normal(size=(12, n)), rng.normal(size=(12, n))


def play(file, n: int, **more) -> Bench[TrajPlay]:
    start = {name: more.pop(name) for name in ("y", "y_dot") if name in more}
    params = {"file": str(file), **more}
    bench = Bench(TrajPlay, params=params, ndof=n, freq=100, **start)
    bench.on(handover=True)
    return bench


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("kind", ["csv", "csv with rates", "npz", "npz with rates"])
def test_traj_play_joins_the_samples_as_scipy_does(tmp_path, n: int, kind: str) -> None:
    time, values, rates = recorded(n)
    file = tmp_path / f"path.{kind[:3]}"
    if "rates" not in kind:
        rates = np.gradient(values, time, axis=0, edge_order=2)
    extra = {"rates": rates} if "rates" in kind else {}
    if kind.startswith("csv"):
        table = np.column_stack((time, values, *extra.values()))
        np.savetxt(file, table, fmt="%.17g", delimiter=",", header="time, values")
    else:
        np.savez(file, time=time, values=values, **extra)
    rng = np.random.default_rng(2)
    y, v = rng.normal(size=(2, n))
    bench = play(file, n, lead=0.5, speed=2.0, y=y, y_dot=v)
    assert np.array_equal(bench.outputs.y, y)
    last = time[-1] - time[0]
    knots = np.concatenate(([0.0], 0.5 + (time - time[0]) / 2.0))
    rows, slopes = np.vstack((y, values)), np.vstack((v, 2.0 * rates))
    wanted = CubicHermiteSpline(knots, rows, slopes)
    k = 1
    while 0.01 * k < 0.5 + last / 2.0:
        bench.step()
        scale = np.abs(slopes).max()
        assert np.abs(bench.outputs.y - wanted(0.01 * k)).max() < 1e-9
        assert np.abs(bench.outputs.y_dot - wanted(0.01 * k, 1)).max() < 1e-8 * scale
        k += 1
    bench.step(n=2)
    assert np.array_equal(bench.outputs.y, values[-1])
    assert not bench.outputs.y_dot.any()
    assert said(bench) == ["FINISH"]


def test_traj_play_repeats_without_a_jump(tmp_path) -> None:
    file = tmp_path / "saw.csv"
    file.write_text("0 0\n1 1\n2 3\n")
    bench = play(file, 1, lead=0.5, repeat=True)
    before = 0.0
    seen = []
    for _ in range(600):
        bench.step()
        seen.append(bench.outputs.y[0])
        mean = bench.outputs.y_dot[0]
        assert abs(seen[-1] - before) < abs(mean) * 0.01 + 0.01
        before = seen[-1]
    assert seen[100 + 49] == pytest.approx(1.0)
    assert seen[249] == pytest.approx(3.0, abs=0.05)
    assert seen[250 + 149] == pytest.approx(1.0), "the second time"
    assert said(bench) == []


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", None, 'there is no file ".*a.csv"'),
        ("a.csv", "", "no rows of numbers"),
        ("a.csv", "time y\nover there\n", "line 2: over there"),
        ("a.csv", "0 1\n1\n", "line 2: 1 values, not 2"),
        ("a.csv", "0 1 2 3\n1 2 3 4\n", "expected 1 values beside the time, or 2"),
        ("a.csv", "0 1\n0 2\n", "times that do not grow"),
        ("a.csv", "0 1\n1 nan\n", "not finite"),
        ("a.npz", "no archive", "not usable"),
    ],
)
def test_traj_play_names_the_fault_of_a_file(tmp_path, name, text, message) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    with pytest.raises(MethodError, match=message) as caught:
        play(file, 1)
    assert name in str(caught.value)


def test_traj_play_has_the_hash_of_its_file_recorded(tmp_path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("0 1\n1 2\n")
    tape = Tape()
    former = use(tape)
    try:
        read_samples("a.csv", 1, [tmp_path])
        player = Player()
        player.feed(tape.take())
        digest = hashlib.sha256(b"0 1\n1 2\n").hexdigest()
        assert files_read(player) == [("a.csv", str(file), digest)]
        use(player)
        file.write_text("0 1\n1 3\n")
        again = read_samples("a.csv", 1, [tmp_path])
        assert again.values.tolist() == [[1.0], [3.0]], "the present one is used"
    finally:
        use(former)
