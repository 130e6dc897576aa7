"""Generic controllers, on a bench and against other computations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import difference, rotation
from pbonet.modules._ode import propagator
from pbonet.modules.controllers.admittance import Admittance
from pbonet.modules.controllers.gripper import Gripper
from pbonet.modules.controllers.hybrid_force import HybridForce
from pbonet.modules.controllers.impedance import Impedance
from pbonet.modules.controllers.lqr import Lqr
from pbonet.modules.controllers.pd_grav import PdGrav
from pbonet.modules.controllers.pid import Pid
from pbonet.testing import Bench

signal = pytest.importorskip("scipy.signal", reason="pip install 'pbonet[design]'")
linalg = pytest.importorskip("scipy.linalg", reason="pip install 'pbonet[design]'")

SIZES = [1, 2, 7, 30]
DT = 0.002


def drawn(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng([seed, *shape]).normal(size=shape)


def pose(seed: int = 0) -> np.ndarray:
    values = drawn(6, seed=seed)
    return np.column_stack((rotation(values[3:]), values[:3]))


def near(base: np.ndarray, step: list[float]) -> np.ndarray:
    moved = np.asarray(step, dtype=float)
    turned = rotation(moved[3:]) @ base[:, :3]
    return np.column_stack((turned, base[:, 3] + moved[:3]))


# -------------------------------------------------------------------------------- pid


def pid(n: int = 1, **values: Any) -> Bench[Pid]:
    wide = {"kp": (2.0,), "lower": (-1e6,), "upper": (1e6,)}
    params = {**wide, **values.pop("params", {})}
    return Bench(Pid, params=params, ndof=n, freq=500, **values)


@pytest.mark.parametrize("n", SIZES)
def test_pid_is_what_the_filters_of_scipy_make_of_it(n: int) -> None:
    gains = {"ki": (3.0,), "kd": (0.5,), "weight": (0.7,), "tau": 0.02}
    ref, measured = drawn(100, n, seed=1), drawn(100, n, seed=2)
    bench = pid(n, params=gains, z_ref=ref[0], z=measured[0])
    bench.on()
    seen = []
    for one, other in zip(ref, measured, strict=True):
        bench.inputs.z_ref, bench.inputs.z = one, other
        bench.step()
        seen.append(bench.outputs.z_cmd.copy())
    proportional = 2.0 * (0.7 * ref - measured)
    integral = signal.lfilter([0.0, 3.0 * DT], [1.0, -1.0], ref - measured, axis=0)
    change = measured - measured[0]
    pole = 0.02 / (0.02 + DT)
    rate = signal.lfilter([1.0, -1.0], [1.0, -pole], change, axis=0) / (0.02 + DT)
    expected = proportional + integral - 0.5 * rate
    expected -= expected[0]  # it began at Z_CMD, which was zero
    assert np.array(seen) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("ki", [0.0, 5.0])
def test_pid_goes_on_from_what_was_commanded(ki: float) -> None:
    bench = pid(2, params={"ki": (ki,)}, z_cmd=[0.4, -0.3], z_ref=[1.0, 1.0])
    bench.on()
    assert bench.outputs.z_cmd == pytest.approx([0.4, -0.3], abs=1e-9)
    bench.step()
    assert bench.outputs.z_cmd == pytest.approx([0.4, -0.3], abs=1e-9)
    bench.step(n=60)
    if ki:
        grown = np.array([0.4, -0.3]) + 60 * 5.0 * DT
        assert bench.outputs.z_cmd == pytest.approx(grown)
    else:
        assert bench.outputs.z_cmd == pytest.approx([2.0, 2.0]), "the distance faded"


def test_pid_leaves_a_limit_as_soon_as_the_error_turns() -> None:
    limits = {"lower": (-1.0,), "upper": (1.0,)}
    bench = pid(params={"ki": (50.0,), **limits}, z_ref=[10.0])
    bench.on()
    bench.step(n=1000)
    assert bench.outputs.z_cmd == pytest.approx([1.0])
    bench.inputs.z_ref = [-0.1]
    bench.step(n=3)
    assert bench.outputs.z_cmd[0] < 1.0, (
        "two seconds at the limit have wound up nothing"
    )


def test_pid_takes_a_step_of_the_reference_without_a_kick() -> None:
    bench = pid(params={"kp": (0.0,), "kd": (1.0,), "tau": 0.0})
    bench.on()
    bench.step()
    bench.inputs.z_ref = [5.0]
    bench.step()
    assert bench.outputs.z_cmd == pytest.approx([0.0])


def test_pid_refuses_limits_without_room() -> None:
    with pytest.raises(MethodError, match="the limits leave no room"):
        pid(params={"lower": (1.0,), "upper": (1.0,)})
    with pytest.raises(MethodError, match="2 values, or one for all"):
        pid(2, params={"kp": (1.0, 2.0, 3.0)})


def test_pid_in_error_wrote_nothing_and_begins_anew() -> None:
    bench = pid(2, params={"ki": (1.0,)}, z_cmd=[0.4, 0.2])
    bench.on()
    bench.step()
    bench.inputs.z = [np.nan, 0.0]
    with pytest.raises(MethodError, match="Z_CMD"):
        bench.step()
    assert bench.state is State.ERROR
    assert bench.outputs.z_cmd == pytest.approx([0.4, 0.2])
    bench.inputs.z = [0.0, 0.0]
    bench.clear()
    bench.on()
    bench.step()
    assert bench.outputs.z_cmd == pytest.approx([0.4, 0.2])


# ---------------------------------------------------------------------------- pd_grav


@pytest.mark.parametrize("n", SIZES)
def test_pd_grav_is_a_spring_a_damper_and_gravity(n: int) -> None:
    q_ref, q, qd, held, before = (drawn(n, seed=seed) for seed in range(5))
    params = {"kp": tuple(range(1, n + 1)), "kd": (0.5,), "limit": (1e3,)}
    values = {"q_ref": q_ref, "q": q, "qd": qd, "t_grav": held, "tau": before}
    bench = Bench(PdGrav, params=params, ndof=n, freq=500, **values)
    bench.on(handover=True)
    bench.step()
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9)
    bench.step(n=60)
    law = np.arange(1, n + 1) * (q_ref - q) - 0.5 * qd + held
    assert bench.outputs.tau == pytest.approx(law, abs=1e-9)
    bench.set("limit", "0.1")
    bench.step()
    assert bench.outputs.tau == pytest.approx(np.clip(law, -0.1, 0.1))


# -------------------------------------------------------------------------- impedance

SPRING = {
    "stiffness": (100.0, 200.0, 300.0, 10.0, 20.0, 30.0),
    "damping": (5.0,),
    "limit": (1e4,),
    "force": 1e4,
    "moment": 1e4,
    "joints": 0.3,
}


def impedance(n: int = 7, **values: Any) -> Bench[Impedance]:
    goal = pose()
    given = {
        "x_des": goal,
        "v_des": drawn(6, seed=3),
        "x": near(goal, [-0.1, 0.2, 0.05, 0.0, 0.0, 0.0]),
        "jacobian": drawn(6, n, seed=4),
        "qd": drawn(n, seed=5),
        "t_grav": drawn(n, seed=6),
    }
    params = {**SPRING, **values.pop("params", {})}
    return Bench(Impedance, params=params, ndof=n, freq=500, **{**given, **values})


@pytest.mark.parametrize("n", SIZES)
def test_impedance_is_a_spring_and_a_damper_at_the_hand(n: int) -> None:
    turn = np.array([0.3, -0.2, 0.1])
    x = near(pose(), [-0.1, 0.2, 0.05, *(-turn)])
    bench = impedance(n, x=x)
    bench.on()
    bench.step(n=60)
    jacobian, qd = drawn(6, n, seed=4), drawn(n, seed=5)
    error = np.array([0.1, -0.2, -0.05, *turn])
    wrench = np.array(SPRING["stiffness"]) * error
    wrench += 5.0 * (drawn(6, seed=3) - jacobian @ qd)
    law = jacobian.T @ wrench - 0.3 * qd + drawn(n, seed=6)
    assert bench.outputs.tau == pytest.approx(law, abs=1e-9)


def test_a_goal_far_away_pulls_no_harder() -> None:
    """With a Jacobian of one the torque is the wrench."""
    still = {"v_des": np.zeros(6), "qd": np.zeros(6), "t_grav": np.zeros(6)}
    bench = impedance(
        6, params={"force": 30.0, "moment": 2.0}, jacobian=np.eye(6), **still
    )
    bench.inputs.x = near(pose(), [3.0, 4.0, 0.0, 0.0, 0.0, 2.0])
    bench.on()
    bench.step(n=60)
    assert np.linalg.norm(bench.outputs.tau[:3]) == pytest.approx(30.0)
    assert np.linalg.norm(bench.outputs.tau[3:]) == pytest.approx(2.0)


def test_a_goal_that_is_none_draws_nothing_and_nothing_jumps() -> None:
    bench = impedance(tau=np.full(7, 2.0))
    bench.on()
    bench.step()
    assert bench.outputs.tau == pytest.approx(np.full(7, 2.0), abs=1e-9)
    bench.step(n=60)
    before = bench.outputs.tau.copy()
    good = bench.inputs.x_des.copy()
    bench.inputs.x_des = np.full((3, 4), np.nan)
    bench.step()
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9)
    bench.step(n=60)
    jacobian, qd = drawn(6, 7, seed=4), drawn(7, seed=5)
    law = -jacobian.T @ (5.0 * jacobian @ qd) - 0.3 * qd + drawn(7, seed=6)
    assert bench.outputs.tau == pytest.approx(law, abs=1e-9)
    (notice,) = bench.notices()
    assert "X_DES is not a pose" in notice.text
    bench.inputs.x_des = good
    bench.step()
    assert bench.outputs.tau == pytest.approx(law, abs=1e-9), "nor when it is back"
    bench.step(n=60)
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9)


# ------------------------------------------------------------------------- admittance

BODY = {
    "mass": (2.0, 3.0, 4.0, 0.1, 0.2, 0.3),
    "damping": (10.0, 50.0, 0.0, 1.0, 2.0, 0.0),
    "stiffness": (100.0, 0.0, 50.0, 5.0, 0.0, 3.0),
    "linear": 10.0,
    "angular": 3.0,
}


def admittance(**values: Any) -> Bench[Admittance]:
    params = {**BODY, **values.pop("params", {})}
    given = {"x_ref": pose(), "x_cmd": pose(), **values}
    return Bench(Admittance, params=params, freq=500, **given)


def test_admittance_moves_as_scipy_s_simulation_of_the_body() -> None:
    bench = admittance()
    bench.on()
    force = 0.5 * drawn(200, 6, seed=7)
    force[:, 3:] *= 0.1
    seen = []
    for one in force:
        bench.inputs.f = one
        bench.step()
        seen.append(difference(bench.outputs.x_cmd, pose()))
    for k in range(6):
        m, d, s = BODY["mass"][k], BODY["damping"][k], BODY["stiffness"][k]
        plant = (
            [[0.0, 1.0], [-s / m, -d / m]],
            [[0.0], [1.0 / m]],
            [[1.0, 0.0]],
            [[0]],
        )
        a, b, c, _, _ = signal.cont2discrete([np.array(one) for one in plant], DT)
        state, expected = np.zeros((2, 1)), []
        for one in force[:, k]:
            state = a @ state + b * one
            expected.append(float((c @ state)[0, 0]))
        assert np.array(seen)[:, k] == pytest.approx(expected, abs=1e-9)


def test_admittance_goes_on_from_the_pose_that_is_commanded() -> None:
    away = near(pose(), [0.05, -0.02, 0.01, 0.1, 0.0, -0.1])
    bench = admittance(x_cmd=away, params={"stiffness": (0.0,)})
    bench.on()
    assert bench.outputs.x_cmd == pytest.approx(away, abs=1e-9)
    bench.step()
    assert bench.outputs.x_cmd == pytest.approx(away, abs=1e-9)


def test_admittance_goes_no_further_than_its_limits() -> None:
    bench = admittance(params={"linear": 0.1, "stiffness": (0.0,)})
    bench.on()
    bench.inputs.f = [30.0, 40.0, 0.0, 0.0, 0.0, 0.0]
    bench.step(n=1500)
    gap = bench.outputs.x_cmd[:, 3] - pose()[:, 3]
    assert np.linalg.norm(gap) == pytest.approx(0.1)
    bench.inputs.f = [-30.0, -40.0, 0.0, 0.0, 0.0, 0.0]
    bench.step(n=50)
    gap = bench.outputs.x_cmd[:, 3] - pose()[:, 3]
    assert np.linalg.norm(gap) < 0.1, "and comes back at once"


@pytest.mark.parametrize("cls", [Admittance, HybridForce])
def test_a_force_that_is_no_number_leaves_the_pose(cls: type) -> None:
    bench = admittance() if cls is Admittance else hybrid()
    bench.on()
    bench.inputs.f = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    bench.step(n=10)
    before = bench.outputs.x_cmd.copy()
    bench.inputs.f = [0.1, 0.0, 0.0, 0.0, np.nan, 0.0]
    bench.step(n=10)
    assert bench.outputs.x_cmd == pytest.approx(before, abs=1e-12)
    (notice,) = bench.notices()
    assert "F_MEZ along the turn about y is not finite" in notice.text
    bench.inputs.f = np.zeros(6)
    bench.step()
    assert bench.outputs.x_cmd == pytest.approx(before, abs=1e-3)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_propagator_is_the_matrix_exponential(n: int) -> None:
    for size in (1e-3, 1.0, 50.0):
        matrix = size * drawn(4, n, n, seed=8)
        matrix -= size * 2.0 * np.eye(n)
        for one, two in zip(propagator(matrix, 0.1), matrix, strict=True):
            expected = linalg.expm(0.1 * two)
            assert one == pytest.approx(expected, rel=1e-9, abs=1e-12)


# ----------------------------------------------------------------------- hybrid_force


def hybrid(**values: Any) -> Bench[HybridForce]:
    contact = {
        "select": (0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        "gain": (0.001,),
        "speed": (0.05,),
        "reach": (0.1,),
    }
    params = {**contact, **values.pop("params", {})}
    given = {"x_ref": pose(), "x_cmd": pose(), **values}
    return Bench(HybridForce, params=params, freq=500, **given)


def test_hybrid_presses_a_wall_with_the_force_that_is_asked_for() -> None:
    """A wall of 10 N/mm along z: the gap settles as exp(-gain stiffness t)."""
    bench = hybrid()
    bench.inputs.f_des = [0.0, 0.0, -20.0, 0.0, 0.0, 0.0]
    bench.on()
    wall, gap = 1e4, 0.0
    for _ in range(400):
        bench.inputs.f = [0.0, 0.0, -wall * gap, 0.0, 0.0, 0.0]
        bench.step()
        change = np.clip(0.001 * (-20.0 - wall * gap) * DT, -0.05 * DT, 0.05 * DT)
        gap += change
        found = difference(bench.outputs.x_cmd, pose())
        assert found == pytest.approx([0.0, 0.0, gap, 0.0, 0.0, 0.0], abs=1e-9)
    assert -wall * gap == pytest.approx(20.0, abs=0.01)


def test_hybrid_follows_the_reference_in_the_other_directions() -> None:
    bench = hybrid()
    bench.on()
    moved = near(pose(), [0.01, -0.02, 0.0, 0.0, 0.0, 0.0])
    bench.inputs.x_ref = moved
    bench.inputs.f = [100.0, 100.0, 0.0, 100.0, 100.0, 100.0]
    bench.step()
    assert bench.outputs.x_cmd == pytest.approx(moved, abs=1e-9)


def test_hybrid_seeks_slowly_and_not_too_far_and_takes_over_without_a_step() -> None:
    away = near(pose(), [0.02, 0.0, 0.03, 0.0, 0.0, 0.0])
    bench = hybrid(x_cmd=away)
    bench.on()
    assert bench.outputs.x_cmd == pytest.approx(away, abs=1e-9)
    bench.inputs.f_des = [0.0, 0.0, 1e3, 0.0, 0.0, 0.0]
    bench.step()
    step = difference(bench.outputs.x_cmd, away)
    assert step == pytest.approx([-1e-4, 0.0, 1e-4, 0.0, 0.0, 0.0], abs=1e-9)
    bench.step(n=3000)
    gap = difference(bench.outputs.x_cmd, pose())
    assert gap == pytest.approx([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], abs=1e-9)


# -------------------------------------------------------------------------------- lqr


def lqr(n: int, m: int, **values: Any) -> Bench[Lqr]:
    a, b = drawn(n, n, seed=9), drawn(n, m, seed=10)
    params = {
        "a": tuple(a.ravel()),
        "b": tuple(b.ravel()),
        "q": (1.0,),
        "r": (0.5,),
        "lower": (-1e3,),
        "upper": (1e3,),
        **values.pop("params", {}),
    }
    return Bench(Lqr, params=params, freq=500, n=n, m=m, **values)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (4, 2), (12, 4)])
def test_lqr_s_gain_satisfies_the_equation_of_riccati(n: int, m: int) -> None:
    """By dynamic programming, backwards from the end until nothing changes."""
    bench = lqr(n, m, z=drawn(n, seed=11), z_ref=drawn(n, seed=12))
    plant = (drawn(n, n, seed=9), drawn(n, m, seed=10), np.eye(n), np.zeros((n, m)))
    a, b, *_ = signal.cont2discrete(plant, DT)
    cost, gain = np.eye(n), np.zeros((m, n))
    for _ in range(20_000):
        new = np.linalg.solve(0.5 * np.eye(m) + b.T @ cost @ b, b.T @ cost @ a)
        cost = np.eye(n) + a.T @ cost @ (a - b @ new)
        if np.abs(new - gain).max() < 1e-14:
            break
        gain = new
    bench.on()
    bench.step(n=60)
    law = gain @ (drawn(n, seed=12) - drawn(n, seed=11))
    assert bench.outputs.u == pytest.approx(law, rel=1e-8, abs=1e-9)


def test_lqr_goes_on_from_what_was_commanded_and_keeps_its_limits() -> None:
    bench = lqr(2, 1, params={"upper": (1.0,)}, u=[0.3], z_ref=[50.0, 50.0])
    bench.on()
    bench.step()
    assert bench.outputs.u == pytest.approx([0.3], abs=1e-9)
    bench.inputs.z_ref = 1e3 * bench.module._gain[0]
    bench.step(n=60)
    assert bench.outputs.u == pytest.approx([1.0])


def test_lqr_refuses_a_plant_that_nothing_stabilizes() -> None:
    with pytest.raises(MethodError, match="no gain stabilizes this plant"):
        lqr(2, 1, params={"a": (1.0, 0.0, 0.0, 2.0), "b": (1.0, 0.0)})
    with pytest.raises(MethodError, match="4: 2 rows of 2, got 2 values"):
        lqr(2, 1, params={"a": (1.0, 0.0)})


# ---------------------------------------------------------------------------- gripper

GRIP = {"kp": 2000.0, "kd": 40.0, "speed": 0.1, "force": 40.0}


class Fingers:
    """Fingers of 0.2 kg on a bench; something between them holds them up."""

    def __init__(self, n: int, opening: float) -> None:
        self.w, self.v, self.block = np.full(n, opening), np.zeros(n), 0.0
        values = {"w": self.w, "w_des": self.w, "ngrip": n}
        self.bench = Bench(Gripper, params=GRIP, freq=500, **values)
        self.bench.on()
        self.fastest = 0.0

    def move(self, goal: float, seconds: float) -> list[int]:
        """Let time pass, in steps of a tenth of a cycle; return what is signalled."""
        bench, signals = self.bench, []
        bench.inputs.w_des = np.full(len(self.w), goal)
        for _ in range(round(500 * seconds)):
            bench.inputs.w, bench.inputs.wd = self.w, self.v
            bench.step()
            for _ in range(10):
                self.v += 2e-4 * bench.outputs.f / 0.2
                self.v[self.w <= self.block] = self.v[self.w <= self.block].clip(0.0)
                self.w = np.maximum(self.w + 2e-4 * self.v, self.block)
            self.fastest = max(self.fastest, np.abs(self.v).max())
            signals += [one.bits for one in bench.notices()]
        return signals


@pytest.mark.parametrize("n", SIZES)
def test_gripper_is_a_spring_and_a_damper_to_a_reference_of_its_speed(n: int) -> None:
    opening, rate = 0.01 * drawn(200, n, seed=1), 0.1 * drawn(200, n, seed=2)
    goal = 0.02 * drawn(n, seed=3)
    before = drawn(n, seed=4)
    values = {"w": opening[0], "w_des": goal, "wd": rate[0], "f": before, "ngrip": n}
    bench = Bench(Gripper, params=GRIP, freq=500, **values)
    bench.on()
    r, laws = opening[0] + before / 2000.0, []
    for k, (w, wd) in enumerate(zip(opening, rate, strict=True)):
        bench.inputs.w, bench.inputs.wd = w, wd
        bench.step()
        for i in range(n):
            r[i] += min(max(goal[i] - r[i], -0.1 * DT), 0.1 * DT)
            r[i] = min(max(r[i], w[i] - 0.02), w[i] + 0.02)
        laws.append(2000.0 * (r - w) - 40.0 * wd)
        x = min(k * DT / 0.1, 1.0)
        left = (1.0 - 3.0 * x**2 + 2.0 * x**3) * (before - laws[0])
        wanted = (laws[-1] + left).clip(-40.0, 40.0)
        assert bench.outputs.f == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("n", [1, 2])
def test_gripper_closes_on_something_holds_it_with_its_force_and_opens(n: int) -> None:
    fingers = Fingers(n, 0.04)
    fingers.block = 0.025
    assert fingers.move(0.04, 0.1) == [Gripper.ARRIVED]
    assert fingers.move(0.0, 1.0) == [Gripper.HOLDS]
    assert fingers.bench.outputs.grip == 2
    assert fingers.bench.outputs.f == pytest.approx(np.full(n, -40.0), abs=1e-9)
    assert fingers.move(0.02, 1.0) == [Gripper.HOLDS], "more gently"
    assert fingers.bench.outputs.f == pytest.approx(np.full(n, -10.0), abs=1e-9)
    assert fingers.move(0.04, 1.0) == [Gripper.ARRIVED]
    assert fingers.w == pytest.approx(np.full(n, 0.04), abs=1e-4)
    assert fingers.fastest < 0.12, "SPEED, and a little for the start"


def test_gripper_tells_what_is_lost_and_goes_on_as_fast_as_it_may() -> None:
    fingers = Fingers(2, 0.04)
    fingers.block = 0.015
    fingers.move(0.0, 1.0)
    fingers.bench.inputs.wd = np.array([3e-3, -3e-3])  # a sensor trembles
    fingers.bench.step()
    assert fingers.bench.outputs.grip == 2
    fingers.block, fingers.fastest = 0.0, 0.0
    told = fingers.move(0.0, 0.6)
    assert told[0] == Gripper.LOST
    assert fingers.fastest < 0.6, "it pressed with 40 N"
    assert fingers.w == pytest.approx(np.zeros(2), abs=1e-3)


def test_gripper_that_takes_over_does_not_let_go() -> None:
    before = np.array([-40.0, -30.0])
    values = {"w": [0.025, 0.025], "w_des": [0.0, 0.0], "f": before, "ngrip": 2}
    bench = Bench(Gripper, params=GRIP, freq=500, **values)
    bench.on()
    for _ in range(150):
        bench.step()
        assert (bench.outputs.f <= before + 1e-9).all()
    assert bench.outputs.f == pytest.approx(np.full(2, -40.0), abs=1e-9)
    assert [one.bits for one in bench.notices()] == [Gripper.HOLDS]


def test_gripper_holds_only_what_has_stood_for_settle() -> None:
    values = {"w": [0.025], "w_des": [0.02], "wd": [0.05], "ngrip": 1}
    bench = Bench(Gripper, params=GRIP, freq=500, **values)
    bench.on()
    bench.step(n=500)
    assert bench.outputs.grip == 0, "the drive moves"
    bench.inputs.wd = [0.0]
    for goal in (0.02, -0.05, -0.06):  # with its whole force at the last two
        bench.inputs.w_des = [goal]
        bench.step(n=49)
        assert bench.outputs.grip == 0
        bench.step(n=300)
        assert bench.outputs.grip == 2
    assert [one.bits for one in bench.notices()] == [Gripper.HOLDS] * 3
