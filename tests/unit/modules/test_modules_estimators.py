"""Sensors and estimators, against scipy and closed forms, on a bench."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_are
from scipy.spatial.transform import Rotation

from pbonet import State
from pbonet.errors import MethodError
from pbonet.modules.sensors.calib import Calib
from pbonet.modules.sensors.imu_fusion import ImuFusion
from pbonet.modules.sensors.kalman import Kalman
from pbonet.modules.sensors.wrench_comp import WrenchComp
from pbonet.testing import Bench

DT = 0.01
G = 9.80665

# ----------------------------------------------------------------------------- kalman


class Linear:
    """A random system of n states, k inputs and m measurements."""

    def __init__(self, n: int, k: int, m: int) -> None:
        rng = np.random.default_rng(n)
        self.a = rng.normal(size=(n, n)) / (2.0 * math.sqrt(n))
        self.b, self.c = rng.normal(size=(n, k)), rng.normal(size=(m, n))
        self.q, self.r, self.p0 = (self.covariance(rng, d) for d in (n, m, n))
        self.z, self.u = rng.normal(size=(6, m)), rng.normal(size=(6, k))
        self.x0 = rng.normal(size=n)

    @staticmethod
    def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
        root = rng.normal(size=(n, n))
        found = root @ root.T + np.eye(n)
        return (found + found.T) / 2.0

    def bench(self, **more) -> Bench[Kalman]:
        names = ("a", "b", "c", "q", "r", "p0")
        params = {name: getattr(self, name).ravel() for name in names}
        (n, k), m = self.b.shape, len(self.c)
        sizes = {"nx": n, "nu": k, "nz": m}
        values = {"z": self.z[0], "u": self.u[0], "x": self.x0, **sizes}
        bench = Bench(Kalman, params={**params, **more}, freq=1 / DT, **values)
        bench.on()
        return bench

    def least_squares(self, steps: int, without=()) -> np.ndarray:
        """Return the last state by weighted least squares over all of them at once.

        Cycles `without` have no measurement.
        """
        n = len(self.x0)
        rows, wanted, weights = [np.eye(n, n * (steps + 1))], [self.x0], [self.p0]
        for k in range(steps):
            row = np.zeros((n, n * (steps + 1)))
            row[:, n * (k + 1) : n * (k + 2)] = np.eye(n)
            row[:, n * k : n * (k + 1)] = -self.a
            rows.append(row)
            wanted.append(self.b @ self.u[max(k - 1, 0)])
            weights.append(self.q)
            if k not in without:
                row = np.zeros((len(self.c), n * (steps + 1)))
                row[:, n * (k + 1) : n * (k + 2)] = self.c
                rows.append(row)
                wanted.append(self.z[k])
                weights.append(self.r)
        left, right = np.vstack(rows), np.concatenate(wanted)
        inverse = np.linalg.inv(block_diag(*weights))
        return np.linalg.solve(left.T @ inverse @ left, left.T @ inverse @ right)[-n:]


def feed(bench: Bench[Kalman], system: Linear, steps: int) -> None:
    for k in range(steps):
        bench.inputs.z, bench.inputs.u = system.z[k], system.u[k]
        bench.step()


@pytest.mark.parametrize(
    ("n", "k", "m"), [(1, 1, 1), (2, 1, 2), (7, 3, 4), (30, 2, 30)]
)
def test_kalman_is_the_least_squares_of_all_measurements(n, k, m) -> None:
    system = Linear(n, k, m)
    bench = system.bench()
    assert np.array_equal(bench.outputs.x, system.x0), "bumpless"
    feed(bench, system, 6)
    assert np.abs(bench.outputs.x - system.least_squares(6)).max() < 1e-9


@pytest.mark.parametrize("how", ["stale", "nan"])
def test_kalman_predicts_without_a_measurement(how: str) -> None:
    system = Linear(3, 1, 2)
    bench = system.bench()
    for k in range(6):
        bench.inputs.z, bench.inputs.u = system.z[k], system.u[k]
        if 2 <= k < 5 and how == "nan":
            bench.inputs.z = [math.nan, 0.0]
        bench.stale = {"z"} if 2 <= k < 5 and how == "stale" else set()
        bench.step()
    wanted = system.least_squares(6, (2, 3, 4))
    assert np.abs(bench.outputs.x - wanted).max() < 1e-9


def test_kalman_predicts_as_often_as_cycles_were_missed() -> None:
    system = Linear(3, 1, 2)
    system.u[:] = system.u[0]
    bench = system.bench()
    bench.inputs.z = system.z[3]
    bench.step(4 * DT)
    wanted = system.least_squares(4, (0, 1, 2))
    assert np.abs(bench.outputs.x - wanted).max() < 1e-9


def test_kalman_has_the_steady_gain_of_scipys_riccati_equation() -> None:
    system = Linear(4, 1, 2)
    bench = system.bench()
    for _ in range(200):
        bench.step()
    p = solve_discrete_are(system.a.T, system.c.T, system.q, system.r)
    gain = p @ system.c.T @ np.linalg.inv(system.c @ p @ system.c.T + system.r)
    x = bench.outputs.x.copy()
    bench.inputs.z = system.z[1]
    bench.step()
    ahead = system.a @ x + system.b @ system.u[0]
    wanted = ahead + gain @ (system.z[1] - system.c @ ahead)
    assert np.abs(bench.outputs.x - wanted).max() < 1e-9


def test_kalman_recovers_after_a_long_time_without_a_measurement() -> None:
    """The covariance of an unstable system does not grow beyond all numbers."""
    params = {"a": (1.5,), "b": (0.0,), "c": (1.0,), "q": (1.0,), "r": (1.0,)}
    bench = Bench(Kalman, params=params, freq=100, nx=1, nu=1, nz=1)
    bench.on()
    bench.stale = {"z"}
    bench.step(n=3000)
    bench.stale = set()
    bench.inputs.z = [5.0]
    bench.step(n=2)
    assert bench.outputs.x == pytest.approx([5.0], abs=3.0)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("a", (1.0, 2.0), "expected 4: 2 rows of 2, got 2 values"),
        ("q", (1.0, 2.0, 3.0), "one for all of it, got 3 values"),
        ("q", (1.0, 2.0, 3.0, 1.0), "no covariance"),
        ("q", (1.0, 2.0, 2.0, 1.0), "eigenvalues of 0 or more"),
        ("r", (0.0,), "eigenvalues above 0"),
    ],
)
def test_kalman_refuses_what_is_no_system(name, value, text) -> None:
    with pytest.raises(MethodError, match=text):
        Linear(2, 1, 1).bench(**{name: value})


def test_kalman_ends_in_error_when_its_input_is_no_number() -> None:
    system = Linear(2, 1, 1)
    bench = system.bench()
    bench.inputs.u = [math.nan]
    bench.step()
    with pytest.raises(MethodError, match=r"not a finite number: STATE\[0\]"):
        bench.step()
    bench.clear()
    bench.inputs.u = [0.0]
    bench.on()
    assert bench.step() is State.ON


# ------------------------------------------------------------------------- imu_fusion


def imu(att=None, **params) -> Bench[ImuFusion]:
    table = {} if att is None else {"att": att}
    bench = Bench(ImuFusion, params=params, freq=1 / DT, acc=[0, 0, G], **table)
    bench.on()
    return bench


def test_imu_integrates_a_constant_rate_exactly() -> None:
    start, rate = Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.4, -1.3, 0.8])
    bench = imu(start.as_matrix(), kp=0.0, ki=0.0)
    assert np.array_equal(bench.outputs.att, start.as_matrix()), "bumpless"
    bench.inputs.gyr = rate
    for k in range(1, 1001):
        bench.step()
        if k % 50 == 0:
            wanted = (start * Rotation.from_rotvec(rate * DT * k)).as_matrix()
            assert np.abs(bench.outputs.att - wanted).max() < 1e-9
    assert bench.outputs.rate.tolist() == rate.tolist()


def test_imu_stays_where_both_sensors_agree() -> None:
    start, rate = Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.4, -1.3, 0.8])
    bench = imu(start.as_matrix(), kp=2.0, ki=0.5)
    bench.inputs.gyr = rate
    for k in range(300):
        true = start * Rotation.from_rotvec(rate * DT * k)
        bench.inputs.acc = true.inv().apply([0, 0, G])
        bench.step()
    wanted = start * Rotation.from_rotvec(rate * DT * 300)
    assert np.abs(bench.outputs.att - wanted.as_matrix()).max() < 1e-9


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0.6, 0.8, 0)])
def test_imu_loses_a_tilt_as_fast_as_its_gain_says(axis) -> None:
    """Without rotation the tilt a follows a[k+1] = a[k] - kp dt sin a[k]."""
    bench = imu(Rotation.from_rotvec(1.2 * np.array(axis)).as_matrix(), kp=3.0, ki=0.0)
    angle = 1.2
    for _ in range(200):
        bench.step()
        angle -= 3.0 * DT * math.sin(angle)
        wanted = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        assert np.abs(bench.outputs.att - wanted).max() < 1e-9


def test_imu_learns_the_bias_of_its_gyroscope() -> None:
    bench = imu(kp=2.0, ki=1.0)
    bench.inputs.gyr = [0.05, -0.03, 0.0]
    bench.step(n=3000)
    assert np.abs(bench.outputs.rate).max() < 1e-6
    assert np.abs(bench.outputs.att - np.eye(3)).max() < 1e-6
    bench.off()
    bench.on()
    bench.step()
    assert np.abs(bench.outputs.rate).max() < 1e-6, "the bias is still known"


@pytest.mark.parametrize(
    "up", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, -0.8), (0.48, -0.6, 0.64)]
)
def test_imu_begins_level_with_gravity(up) -> None:
    bench = Bench(ImuFusion, freq=1 / DT, acc=G * np.array(up))
    bench.on()
    att = bench.outputs.att
    assert att @ up == pytest.approx([0, 0, 1], abs=1e-9)
    assert att.T @ att == pytest.approx(np.eye(3), abs=1e-9)
    bench.step()
    assert att @ up == pytest.approx([0, 0, 1], abs=1e-9)


def test_imu_does_not_take_an_acceleration_for_gravity() -> None:
    bench = imu(np.eye(3), kp=2.0)
    bench.inputs.acc = [8.0, 0.0, G]
    bench.step(n=50)
    assert np.array_equal(bench.outputs.att, np.eye(3))
    bench.inputs.acc = [1.0, 0.0, G]
    bench.step(n=50)
    assert bench.outputs.att[2, 0] > 0.01
    bench.inputs.acc = [0.0, 0.0, 0.0]
    bench.set("band", 20.0)
    assert bench.step() is State.ON, "free fall"


@pytest.mark.parametrize("port", ["acc", "gyr"])
def test_imu_ends_in_error_when_a_sensor_gives_no_number(port: str) -> None:
    bench = imu(np.eye(3))
    setattr(bench.inputs, port, [0.0, math.nan, G])
    with pytest.raises(MethodError, match="not a finite number"):
        bench.step()
    assert np.array_equal(bench.outputs.att, np.eye(3))
    bench.clear()
    setattr(bench.inputs, port, [0.0, 0.0, G if port == "acc" else 0.0])
    bench.on()
    assert bench.step() is State.ON


@pytest.mark.parametrize("acc", [(0, 0, 0), (0, math.nan, 1)])
def test_imu_does_not_begin_without_a_vertical(acc) -> None:
    bench = Bench(ImuFusion, freq=1 / DT, acc=acc)
    with pytest.raises(MethodError, match="nothing says what is up"):
        bench.on()


def test_quaternions_are_those_of_scipy() -> None:
    from pbonet.modules._quaternion import matrix_of, product, quaternion_of

    rng = np.random.default_rng(1)
    for turn in [*rng.normal(scale=3.0, size=(50, 3)), *(math.pi * np.eye(3))]:
        one = Rotation.from_rotvec(turn)
        q = quaternion_of(one.as_matrix())
        assert matrix_of(q) == pytest.approx(one.as_matrix(), abs=1e-12)
        other = Rotation.random(rng=rng)
        x, y, z, w = other.as_quat()
        both = matrix_of(product(q, (w, x, y, z)))
        assert both == pytest.approx((one * other).as_matrix(), abs=1e-12)


# ------------------------------------------------------------------------ wrench_comp

TOOL = {"mass": 1.3, "com": (0.02, -0.01, 0.08), "bias": (1, -2, 3, 0.1, 0.2, -0.3)}


def pose(turn) -> np.ndarray:
    return np.hstack((Rotation.from_rotvec(turn).as_matrix(), np.ones((3, 1))))


def hanging(turn, touch=(0.0,) * 6) -> np.ndarray:
    """Return what the sensor shows: zero, weight in its axes, and a touch."""
    weight = Rotation.from_rotvec(turn).inv().apply([0.0, 0.0, -1.3 * G])
    torque = np.cross(TOOL["com"], weight)
    return np.concatenate((weight, torque)) + TOOL["bias"] + touch


@pytest.mark.parametrize("frame", ["sensor", "base"])
def test_wrench_comp_leaves_what_touches_the_tool(frame: str) -> None:
    rng = np.random.default_rng(2)
    bench = Bench(WrenchComp, params={**TOOL, "frame": frame})
    bench.on()
    for turn, touch in zip(
        rng.normal(size=(20, 3)), rng.normal(size=(20, 6)), strict=True
    ):
        bench.inputs.x, bench.inputs.raw = pose(turn), hanging(turn, touch)
        bench.step()
        wanted = touch
        if frame == "base":
            turned = Rotation.from_rotvec(turn)
            wanted = np.concatenate((turned.apply(touch[:3]), turned.apply(touch[3:])))
        assert np.abs(bench.outputs.f - wanted).max() < 1e-9


def test_wrench_comp_makes_the_present_wrench_the_zero() -> None:
    params = {"mass": 1.3, "com": TOOL["com"], "tare": True}
    start = hanging([1.0, 0.2, 0.0])
    bench = Bench(WrenchComp, params=params, x=pose([1.0, 0.2, 0.0]), raw=start)
    bench.on()
    bench.inputs.x, bench.inputs.raw = pose([0, 2, 1]), hanging([0, 2, 1], [1.0] * 6)
    bench.step()
    assert np.abs(bench.outputs.f - 1.0).max() < 1e-9
    bench.set("bias", (0.0,) * 6)
    bench.step()
    assert bench.outputs.f == pytest.approx(np.add(TOOL["bias"], 1.0))


def test_wrench_comp_ends_in_error_without_a_number() -> None:
    bench = Bench(WrenchComp, params=TOOL, raw=[0, math.nan, 0, 0, 0, 0])
    bench.on()
    with pytest.raises(MethodError, match=r"not a finite number: F_MEZ\[1\]"):
        bench.step()


# ------------------------------------------------------------------------------ calib


@pytest.mark.parametrize(("nraw", "n"), [(1, 1), (7, 7), (8, 6), (30, 30)])
def test_calib_is_a_matrix_and_an_offset(nraw: int, n: int) -> None:
    rng = np.random.default_rng(n)
    matrix, offset = rng.normal(size=(n, nraw)), rng.normal(size=nraw)
    params = {"matrix": matrix.ravel(), "offset": offset}
    bench = Bench(Calib, params=params, nraw=nraw, nz=n)
    bench.on()
    bench.inputs.raw = raw = rng.normal(size=nraw)
    bench.step()
    wanted = [sum(row[k] * (raw[k] - offset[k]) for k in range(nraw)) for row in matrix]
    assert np.abs(bench.outputs.z - wanted).max() < 1e-9


def test_calib_takes_a_factor_a_diagonal_and_refuses_the_rest() -> None:
    bench = Bench(Calib, params={"matrix": (2.0,)}, raw=[1.0, 2.0], z=[0.0, 0.0])
    bench.on()
    bench.step()
    assert bench.outputs.z.tolist() == [2.0, 4.0]
    bench.set("matrix", (2.0, 3.0))
    bench.step()
    assert bench.outputs.z.tolist() == [2.0, 6.0]
    with pytest.raises(MethodError, match="parameter matrix has the wrong number"):
        bench.set("matrix", (1.0, 2.0, 3.0))
    with pytest.raises(MethodError, match="expected 6: 2 rows of 3, got 1 values"):
        Bench(Calib, params={"matrix": (2.0,)}, raw=[1.0] * 3, z=[0.0] * 2)


def test_calib_ends_in_error_without_a_number() -> None:
    bench = Bench(Calib, params={"matrix": (2.0,)}, nraw=1, nz=1)
    bench.on()
    bench.inputs.raw = [math.nan]
    with pytest.raises(MethodError, match=r"not a finite number: Z\[0\]"):
        bench.step()
