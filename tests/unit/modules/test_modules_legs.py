"""Modules for robots on legs, on a bench: contact, whole_body and whole_body_dyn."""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from urdf_walkers import feet_of, write_walker

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import FloatingModel, rotation
from pbonet.modules.controllers.whole_body_dyn import WholeBodyDyn
from pbonet.modules.kinematics.whole_body import WholeBody
from pbonet.modules.sensors.contact import Contact
from pbonet.testing import Bench

pin = pytest.importorskip("pinocchio", reason="pip install 'pbonet[robot]'")

DT = 0.002
QUADRUPED = Path(__file__).parents[3] / "examples" / "quadruped"
FEET = ("lf_foot", "lh_foot", "rf_foot", "rh_foot")
BEND = float(np.arccos(0.75))
STAND = np.array([0.0, BEND, -2.0 * BEND] * 4)
BODY = np.column_stack((np.eye(3), [0.0, 0.0, 0.32]))
PLACES = np.array([[x, y, 0.02] for y in (0.15, -0.15) for x in (0.18, -0.18)])
SIZES = [(1, 3), (2, 6), (4, 3), (6, 5)]


class Reference:
    """Pinocchio's own functions on a robot whose base moves."""

    def __init__(self, path: Path, feet: tuple[str, ...]) -> None:
        self.model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
        self.data = self.model.createData()
        self.feet = [self.model.getFrameId(name) for name in feet]
        self.body = self.model.getFrameId("body")

    def state(self, x: np.ndarray, v: np.ndarray, q: np.ndarray, qd: np.ndarray):
        turned = x[:, :3]
        place = np.concatenate((x[:, 3], pin.Quaternion(turned).coeffs(), q))
        return place, np.concatenate((turned.T @ v[:3], turned.T @ v[3:], qd))

    def jacobian(self, q: np.ndarray, frame: int) -> np.ndarray:
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        world = pin.LOCAL_WORLD_ALIGNED
        return np.array(pin.getFrameJacobian(self.model, self.data, frame, world))

    def place(self, q: np.ndarray, frame: int) -> np.ndarray:
        pin.framesForwardKinematics(self.model, self.data, q)
        found = self.data.oMf[frame]
        return np.column_stack((found.rotation, found.translation))

    def moving(self, state: Any, frame: int) -> np.ndarray:
        """Return the acceleration that a frame has without those of joints and base."""
        pin.forwardKinematics(self.model, self.data, *state, 0.0 * state[1])
        world = pin.LOCAL_WORLD_ALIGNED
        found = pin.getFrameClassicalAcceleration(self.model, self.data, frame, world)
        return np.concatenate((found.linear, found.angular))

    def levers(self, q: np.ndarray) -> np.ndarray:
        return np.column_stack([self.jacobian(q, foot)[:3, 6:].T for foot in self.feet])

    def gravity(self, q: np.ndarray) -> np.ndarray:
        return np.array(pin.computeGeneralizedGravity(self.model, self.data, q))


def motion(rng: np.random.Generator, n: int) -> tuple[np.ndarray, ...]:
    turn = rotation(rng.normal(size=3))
    x = np.column_stack((turn, rng.normal(size=3)))
    q = 0.6 * rng.normal(size=n) + np.resize([0.1, 0.7, -1.2], n)
    return x, rng.normal(size=6), q, rng.normal(size=n)


# ---------------------------------------------------------------------------- contact


def observer(folder: Path, legs: int, joints: int, **values: Any) -> Bench[Contact]:
    params = {"urdf": write_walker(folder, legs, joints), "feet": feet_of(legs)}
    params |= values.pop("params", {})
    values = {"ndof": legs * joints, "nfeet": legs, "x": np.eye(3, 4), **values}
    return Bench(Contact, params=params, library=[folder], freq=1 / DT, **values)


@pytest.mark.parametrize(("legs", "joints"), SIZES)
def test_forces_are_those_of_the_momenta_by_pinocchio(
    legs: int, joints: int, tmp_path: Path
) -> None:
    """By the mass matrix, the Coriolis matrix, and least squares."""
    rng = np.random.default_rng(1)
    n = legs * joints
    first = rng.normal(size=(legs, 3))
    bench = observer(tmp_path, legs, joints, force=first)
    ref = Reference(tmp_path / "walker.urdf", feet_of(legs))
    bench.on()
    r = p = drift = None
    for _ in range(4):
        x, v, q, qd = motion(rng, n)
        tau = rng.normal(size=n)
        for name, value in zip("xvq", (x, v, q), strict=True):
            setattr(bench.inputs, name, value)
        bench.inputs.qd, bench.inputs.tau = qd, tau
        bench.step()
        place, speed = ref.state(x, v, q, qd)
        mass = np.array(pin.crba(ref.model, ref.data, place))
        mass = np.triu(mass) + np.triu(mass, 1).T
        coriolis = pin.computeCoriolisMatrix(ref.model, ref.data, place, speed)
        was_p, was_drift = p, drift
        p = (mass @ speed)[6:]
        drift = (coriolis.T @ speed - ref.gravity(place))[6:] - 0.2 * qd
        levers = ref.levers(place)
        if r is None:
            r = levers @ first.ravel()
        else:
            gained = p - was_p - DT * (tau + 0.5 * (drift + was_drift))
            r = (r + 100.0 * gained) / (1.0 + 100.0 * DT)
        force = np.linalg.lstsq(levers, r, rcond=None)[0].reshape(-1, 3)
        scale = np.abs(force).max()
        assert bench.outputs.force == pytest.approx(force, abs=1e-9 * scale)
    assert bench.notices() == []


def standing(**values: Any) -> Bench[Contact]:
    params = {"urdf": "quadruped.urdf", "feet": FEET, **values.pop("params", {})}
    told = {"ndof": 12, "nfeet": 4, "x": BODY, "q": STAND, **values}
    return Bench(Contact, params=params, library=[QUADRUPED], freq=1 / DT, **told)


def test_the_first_force_is_the_one_that_was_there() -> None:
    force = np.array([[1.0, -2.0, 30.0]] * 4)
    bench = standing(force=force, contact=[1.0, 0.0, 1.0, 0.0])
    bench.on()
    assert bench.outputs.force == pytest.approx(force, abs=1e-9)
    bench.step()
    assert bench.outputs.force == pytest.approx(force, abs=1e-9)


def test_a_foot_touches_from_one_force_on_until_another() -> None:
    bench = standing()
    ref = Reference(QUADRUPED / "quadruped.urdf", FEET)
    place, _ = ref.state(BODY, np.zeros(6), STAND, np.zeros(12))
    levers, weight = ref.levers(place), ref.gravity(place)[6:]
    bench.on()
    seen = []
    for up in (10.0, 20.0, 10.0, 5.0, 10.0):
        force = np.array([[2.0, 1.0, up], [0, 0, 30.0], [0, 0, up], [0, 0, 0]])
        bench.inputs.tau = weight - levers @ force.ravel()
        bench.step(n=100)
        assert bench.outputs.force == pytest.approx(force, abs=1e-4)
        seen.append(bench.outputs.contact.tolist())
    expected = [0.0, 1.0, 1.0, 0.0, 0.0]
    assert [one[0] for one in seen] == expected == [one[2] for one in seen]
    assert {one[1] for one in seen} == {1.0}
    assert {one[3] for one in seen} == {0.0}


def test_a_stretched_leg_is_named_and_its_force_stays_finite() -> None:
    bench = standing(force=[[0.0, 0.0, 30.0]] * 4)
    bench.on()
    bench.step()
    largest = 0.0
    ref = Reference(QUADRUPED / "quadruped.urdf", FEET)
    for bend in np.linspace(BEND, 0.0, 300):
        q = STAND.copy()
        q[7], q[8] = bend, -2.0 * bend
        place, _ = ref.state(BODY, np.zeros(6), q, np.zeros(12))
        bench.inputs.q = q
        held = ref.levers(place) @ np.tile([0.0, 0.0, 30.0], 4)
        bench.inputs.tau = ref.gravity(place)[6:] - held
        before = bench.outputs.force.copy()
        bench.step()
        largest = max(largest, float(np.abs(bench.outputs.force - before).max()))
    assert largest < 3.0
    (notice,) = bench.notices()
    assert "the leg of rf_foot is stretched" in notice.text


def bent(*legs: float) -> np.ndarray:
    return np.array([angle for leg in legs for angle in (0.0, leg, -2.0 * leg)])


def limit_of_touch() -> float:
    """Return the bend at which a foot's smallest lever is SIGMA."""
    ref = Reference(QUADRUPED / "quadruped.urdf", FEET)

    def lever(bend: float) -> float:
        place, _ = ref.state(BODY, np.zeros(6), bent(*[bend] * 4), np.zeros(12))
        return float(np.linalg.svd(ref.levers(place), compute_uv=False).min())

    low, high = 0.0, BEND
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if lever(middle) < 0.02 else (low, middle)
    return low


@pytest.mark.parametrize("which", ["stretched", "at the limit"])
def test_legs_that_tremble_are_warned_of_once(which: str) -> None:
    """However the axes that are not felt turn, and how often they are felt again."""
    bend = 0.0 if which == "stretched" else limit_of_touch()
    bench = standing(force=[[0.0, 0.0, 30.0]] * 4, q=bent(*[bend] * 4))
    rng = np.random.default_rng(4)
    bench.on()
    for _ in range(300):
        bench.inputs.q = bent(*[bend] * 4) + 1e-4 * rng.normal(size=12)
        bench.step()
    told = [notice.text for notice in bench.notices()]
    assert 1 <= len(told) <= 4, "each foot once"
    assert all(foot in told[-1] for foot in FEET)


def test_a_leg_that_is_stretched_again_is_told_again() -> None:
    bench = standing(force=[[0.0, 0.0, 30.0]] * 4)
    bench.on()
    for bend in (0.0, BEND, 0.0):
        bench.inputs.q = bent(BEND, bend, BEND, BEND)
        bench.step()
    told = [notice.text for notice in bench.notices()]
    assert len(told) == 2
    assert all("the leg of lh_foot is stretched" in text for text in told)


SENSORS = [
    ("x", (1, 3), "X_MEZ of the base is not a pose"),
    ("v", (4,), "X^_MEZ of the base along the turn about y is not finite"),
    ("q", (5,), "Q_MEZ of joint lh_knee is not finite"),
    ("qd", (6,), "Q^_MEZ of joint rf_roll is not finite"),
    ("tau", (1,), "T_MEZ of joint lf_hip is not finite"),
]


def spoil(bench: Bench[Any], port: str, index: tuple[int, ...]) -> None:
    value = np.array(getattr(bench.inputs, port))
    value[index] = np.nan
    setattr(bench.inputs, port, value)


@pytest.mark.parametrize(("port", "index", "text"), SENSORS)
def test_a_sensor_that_fails_ends_in_error_with_its_joint(
    port: str, index: tuple[int, ...], text: str
) -> None:
    bench = standing(force=[[0.0, 0.0, 30.0]] * 4, contact=[1.0] * 4)
    bench.on()
    spoil(bench, port, index)
    with pytest.raises(MethodError) as caught:
        bench.step()
    assert text in str(caught.value)
    assert bench.state is State.ERROR
    assert bench.outputs.contact.tolist() == [1.0] * 4


def test_thresholds_that_cross_are_refused() -> None:
    with pytest.raises(MethodError, match="touch and not touch at the same time"):
        standing(params={"leave": 15.0})
    with pytest.raises(MethodError, match="touch and not touch"):
        standing().set("touch", "5")


# ------------------------------------------------------------------------- whole_body

GOALS = {"x_body": BODY, "x_feet": PLACES, "q_ref": STAND}


def posture(**values: Any) -> Bench[WholeBody]:
    pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")
    params = {"urdf": "quadruped.urdf", "body": "body", "feet": FEET}
    params |= values.pop("params", {})
    told = {"ndof": 12, "library": [QUADRUPED], **GOALS, **values}
    bench = Bench(WholeBody, params=params, freq=1 / DT, **told)
    bench.on(handover=True)
    return bench


def largest_step(bench: Bench[WholeBody], cycles: int) -> float:
    largest = 0.0
    for _ in range(cycles):
        before = bench.outputs.q_ref.copy()
        bench.step()
        largest = max(largest, float(np.abs(bench.outputs.q_ref - before).max()))
    return largest


@pytest.mark.parametrize(("legs", "joints"), SIZES)
def test_a_step_of_the_whole_body_is_that_of_the_normal_equations(
    legs: int, joints: int, tmp_path: Path
) -> None:
    n, rng = legs * joints, np.random.default_rng(3)
    urdf = write_walker(tmp_path, legs, joints)
    ref = Reference(tmp_path / urdf, feet_of(legs))
    x, _, q, _ = motion(rng, n)
    place, _ = ref.state(x, np.zeros(6), q, np.zeros(n))
    feet = np.array([ref.place(place, foot)[:, 3] for foot in ref.feet])
    goal, wish = x.copy(), 1e-3 * rng.normal(size=(legs, 3))
    bench = posture(
        params={"urdf": urdf, "feet": feet_of(legs), "accel": 1e6},
        library=[tmp_path],
        ndof=n,
        x_body=goal,
        x_feet=feet,
        q_ref=q,
    )
    bench.step()
    assert bench.outputs.q_ref == pytest.approx(q, abs=1e-9), "it is where it is to be"
    bench.inputs.x_feet, q = feet + wish, bench.outputs.q_ref.copy()
    bench.step()
    rows = [5.0 * ref.jacobian(place, ref.body)[:3], ref.jacobian(place, ref.body)[3:]]
    rows += [50.0 * ref.jacobian(place, foot)[:3] for foot in ref.feet]
    matrix = np.vstack(rows)
    right = np.concatenate((np.zeros(6), 50.0 * (50.0 * DT * wish).ravel()))
    normal = matrix.T @ matrix + 1e-4 * np.eye(n + 6)
    step = np.linalg.solve(normal, matrix.T @ right)[6:]
    assert bench.outputs.q_ref == pytest.approx(q + step, abs=1e-9)
    assert bench.outputs.qd_ref == pytest.approx(step / DT, abs=1e-6)


def test_body_and_feet_arrive_and_no_joint_jumps() -> None:
    bench = posture()
    goal = BODY.copy()
    goal[:, :3] = rotation(np.array([0.05, -0.1, 0.1]))
    goal[:, 3] += [0.02, 0.01, -0.05]
    places = PLACES.copy()
    places += [[0.03, 0.0, 0.05], [0, 0, 0], [0, 0.02, 0], [-0.02, 0, 0]]
    bench.inputs.x_body, bench.inputs.x_feet = goal, places
    assert largest_step(bench, 400) < 0.02
    ref = Reference(QUADRUPED / "quadruped.urdf", FEET)
    place, _ = ref.state(goal, np.zeros(6), bench.outputs.q_ref, np.zeros(12))
    for foot, wanted in zip(ref.feet, places, strict=True):
        assert ref.place(place, foot)[:, 3] == pytest.approx(wanted, abs=1e-9)
    assert bench.notices() == []


def rates(bench: Bench[WholeBody], cycles: int) -> np.ndarray:
    """Return Q^_REF as it is, and after each of so many cycles."""
    found = [bench.outputs.qd_ref.copy()]
    for _ in range(cycles):
        bench.step()
        found.append(bench.outputs.qd_ref.copy())
    return np.array(found)


@pytest.mark.parametrize(
    ("shift", "turn"),
    [
        ((0.04, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, -0.02, -0.04), (0.0, 0.05, 0.0)),
        ((0.0, 0.0, 0.0), (0.1, 0.0, -0.1)),
    ],
)
def test_a_body_whose_goal_is_elsewhere_goes_there_from_where_it_is(
    shift: tuple[float, ...], turn: tuple[float, ...]
) -> None:
    """Its feet stay, its speed grows by ACCEL, and no joint jumps."""
    goal = BODY.copy()
    goal[:, 3] += shift
    goal[:, :3] = rotation(np.array(turn))
    bench = posture(x_body=goal)
    assert bench.outputs.q_ref == pytest.approx(STAND, abs=1e-12)
    bench.step()
    assert bench.outputs.q_ref == pytest.approx(STAND, abs=1e-9), "taken over as it is"
    ref = Reference(QUADRUPED / "quadruped.urdf", FEET)
    own = np.linalg.norm(PLACES - PLACES[0], axis=1)
    for _ in range(6):
        assert np.abs(np.diff(rates(bench, 40), axis=0)).max() < 1.0, "rad/s a cycle"
        place, _ = ref.state(goal, np.zeros(6), bench.outputs.q_ref, np.zeros(12))
        feet = np.array([ref.place(place, foot)[:, 3] for foot in ref.feet])
        between = np.linalg.norm(feet - feet[0], axis=1)
        assert between == pytest.approx(own, abs=5e-4), "the feet stay"
    assert feet == pytest.approx(PLACES, abs=1e-4), "the body is in its goal"
    assert bench.notices() == []


def test_a_motion_that_is_handed_over_goes_on_as_fast_as_it_was() -> None:
    goal, bench = BODY.copy(), posture()
    for k in range(200):
        goal[:, 3] = BODY[:, 3] + [0.0, 0.0, -0.1 * DT * k]
        bench.inputs.x_body = goal
        bench.step()
    bench.off(handover=True)
    before = bench.outputs.qd_ref.copy()
    assert np.abs(before).max() > 0.3
    goal[2, 3] -= 0.1 * DT
    told = {"q_ref": bench.outputs.q_ref, "qd_ref": before, "x_body": goal}
    successor = posture(**told)
    successor.step()
    assert successor.outputs.qd_ref == pytest.approx(before, abs=0.02)


def test_a_goal_that_jumps_is_approached_by_accel_and_linear() -> None:
    bench = posture(params={"accel": 2.0, "linear": 0.1})
    bench.step(n=3)
    goal = BODY.copy()
    goal[2, 3] -= 0.1
    bench.inputs.x_body = goal
    speeds = []
    for _ in range(100):
        was = bench.module._pose[2, 3]
        bench.step()
        speeds.append((was - bench.module._pose[2, 3]) / DT)
    assert np.diff(speeds).max() < 2.0 * DT * 1.05
    assert max(speeds) == pytest.approx(0.1, rel=0.02)


@pytest.mark.parametrize(
    ("port", "place"), [("x_body", (0, 3)), ("x_body", (2, 3)), ("x_feet", (1, 0))]
)
def test_joints_keep_their_acceleration_when_a_goal_is_out_of_reach(
    port: str, place: tuple[int, int]
) -> None:
    bench = posture()
    bench.step(n=3)
    far = np.array(getattr(bench.inputs, port))
    far[place] += 5.0
    setattr(bench.inputs, port, far)
    found = [bench.outputs.qd_ref.copy()]
    for _ in range(3000):
        bench.step()
        found.append(bench.outputs.qd_ref.copy())
    most = np.abs(np.diff(found, axis=0)).max()
    allowed = 500.0 * DT
    assert 0.8 * allowed < most < allowed * (1 + 1e-6), "much of it, and no more"
    assert np.abs(found[-1]).max() < 1e-3, "and they come to rest"


def test_a_foot_out_of_reach_is_named_and_comes_back() -> None:
    bench = posture()
    places = PLACES.copy()
    places[2, 0] += 1.0
    bench.inputs.x_feet = places
    assert largest_step(bench, 500) < 0.031, "the joints' largest speed"
    (notice,) = bench.notices()
    assert "frame rf_foot cannot follow X_FEET_DES" in notice.text
    bench.inputs.x_feet = PLACES
    assert largest_step(bench, 800) < 0.031
    assert bench.outputs.q_ref == pytest.approx(STAND, abs=1e-3)


def test_a_body_too_low_stops_at_limits_that_are_named() -> None:
    bench = posture(params={"grip": 1e4})
    goal = BODY.copy()
    goal[2, 3] = 0.06
    bench.inputs.x_body = goal
    largest_step(bench, 500)
    (notice,) = bench.notices()
    assert "frame body cannot follow X_BODY_DES" in notice.text
    assert "knee is at its limit, -2.6000 rad of -2.6000 to -0.2000" in notice.text
    assert bench.outputs.q_ref.min() >= -2.6 - 1e-6


def test_limits_that_cannot_be_kept_leave_the_posture() -> None:
    bad = STAND.copy()
    bad[5] = 0.5
    bench = posture(q_ref=bad)
    bench.step(n=3)
    assert bench.outputs.q_ref == pytest.approx(bad, abs=1e-12)
    (notice,) = bench.notices()
    assert "lh_knee is at its limit, 0.5000 rad" in notice.text
    assert "Q_REF does not change" in notice.text


@pytest.mark.parametrize(
    ("port", "index", "text"),
    [
        ("x_body", (0, 3), "X_BODY_DES of frame body is not a pose"),
        ("x_body", (1, 1), "X_BODY_DES of frame body is not a pose"),
        ("x_feet", (2, 1), "X_FEET_DES of frame rf_foot is not finite"),
    ],
)
def test_a_goal_of_the_body_that_is_none_leaves_the_posture(
    port: str, index: tuple[int, ...], text: str
) -> None:
    bench = posture()
    bench.step()
    spoil(bench, port, index)
    bench.step(n=3)
    assert bench.outputs.q_ref == pytest.approx(STAND, abs=1e-6)
    (notice,) = bench.notices()
    assert text in notice.text
    bench.inputs.x_body, bench.inputs.x_feet = BODY, PLACES
    bench.step()
    assert bench.state is State.ON


# --------------------------------------------------------------------- whole_body_dyn


def torques(**values: Any) -> Bench[WholeBodyDyn]:
    pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")
    params = {"urdf": "quadruped.urdf", "body": "body", "feet": FEET}
    params |= values.pop("params", {})
    told = {
        "ndof": 12,
        "x_des": BODY,
        "contact": [1.0] * 4,
        "q_ref": STAND,
        "x": BODY,
        "q": STAND,
        "library": [QUADRUPED],
        **values,
    }
    bench = Bench(WholeBodyDyn, params=params, freq=1 / DT, **told)
    bench.on()
    return bench


def contacts(ref: Reference, state: Any, stands: list[int]) -> tuple[Any, ...]:
    """Return M, h, J of feet that stand, and the accelerations that stop them."""
    place, speed = state
    model, data = ref.model, ref.data
    mass = np.array(pin.crba(model, data, place))
    mass = np.triu(mass) + np.triu(mass, 1).T
    drift = np.array(pin.rnea(model, data, place, speed, 0.0 * speed))
    levers = np.vstack([ref.jacobian(place, ref.feet[k])[:3] for k in stands])
    moving = np.concatenate([ref.moving(state, ref.feet[k])[:3] for k in stands])
    return mass, drift, levers, -20.0 * levers @ speed - moving


def test_torques_are_the_least_squares_of_pinocchio_s_dynamics() -> None:
    """Where no foot slips and no joint is at its effort; regularized as placo does."""
    goal = BODY.copy()
    goal[:, 3] += [0.004, -0.003, 0.005]
    rng = np.random.default_rng(5)
    v, qd = 0.02 * rng.normal(size=6), 0.05 * rng.normal(size=12)
    bench = torques(x_des=goal, v=v, qd=qd, v_des=[0.01] * 6)
    bench.step(n=60)
    ref = Reference(QUADRUPED / "quadruped.urdf", FEET)
    state = ref.state(BODY, v, STAND, qd)
    mass, drift, levers, rest = contacts(ref, state, [0, 1, 2, 3])
    joints, none = np.eye(12, 18, 6), np.zeros((12, 12))
    wanted = np.concatenate((200.0 * (goal - BODY)[:, 3], np.zeros(3)))
    wanted += 28.0 * (0.01 - v) - ref.moving(state, ref.body)
    torque = np.hstack((mass[6:], -levers.T[6:]))
    rows = np.vstack((
        np.hstack((ref.jacobian(state[0], ref.body), np.zeros((6, 12)))),
        1e-3**0.5 * np.hstack((joints, none)),
        1e-3**0.5 * torque,
        1e-8**0.5 * np.eye(30),
    ))
    right = np.concatenate((
        wanted,
        1e-3**0.5 * -40.0 * qd,
        -(1e-3**0.5) * drift[6:],
        np.zeros(30),
    ))
    hard = np.vstack((np.hstack((mass[:6], -levers.T[:6])), np.hstack((levers, none))))
    whole = np.block([[rows.T @ rows, hard.T], [hard, np.zeros((18, 18))]])
    given = np.concatenate((rows.T @ right, -drift[:6], rest))
    found = np.linalg.solve(whole, given)[:30]
    law = torque @ found + drift[6:] + 0.1 * qd
    assert bench.outputs.tau == pytest.approx(law, abs=1e-9)
    assert found[18:].reshape(-1, 3)[:, 2].min() > 0.0


def test_torque_goes_on_from_what_was_commanded_and_fades() -> None:
    before = np.linspace(-5.0, 6.0, 12)
    bench = torques(tau=before)
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9)
    bench.step()
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9)
    steps = []
    for _ in range(60):
        last = bench.outputs.tau.copy()
        bench.step()
        steps.append(np.abs(bench.outputs.tau - last).max())
    assert max(steps) < 0.3, "a fiftieth of the distance, at most 1.5 times"
    assert steps[-1] < 1e-6, "and then the law has it alone"


def test_a_foot_in_the_air_goes_where_its_joints_are_to_be() -> None:
    """The others carry the robot; gravity and inertia of the leg count, too."""
    q_ref = STAND.copy()
    q_ref[6:9] += [0.02, 0.03, -0.04]
    bench = torques(contact=[1.0, 1.0, 0.0, 1.0], q_ref=q_ref)
    bench.step(n=60)
    ref = Reference(QUADRUPED / "quadruped.urdf", FEET)
    state = ref.state(BODY, np.zeros(6), STAND, np.zeros(12))
    mass, drift, levers, rest = contacts(ref, state, [0, 1, 3])
    whole = np.block([[mass, -levers.T], [levers, np.zeros((9, 9))]])
    given = np.concatenate((np.zeros(6), bench.outputs.tau)) - drift
    a, force = np.split(np.linalg.solve(whole, np.concatenate((given, rest))), [18])
    assert a[12:15] == pytest.approx(400.0 * np.array([0.02, 0.03, -0.04]), rel=0.05)
    assert force.reshape(-1, 3)[:, 2].min() > 0.0
    bench.inputs.contact = [1.0] * 4
    bench.step()
    assert bench.state is State.ON


def test_a_body_that_cannot_follow_its_goal_is_told_once() -> None:
    """Its torques stay within the efforts, wherever the goal is."""
    near, far = BODY.copy(), BODY.copy()
    near[2, 3] += 0.02
    far[2, 3] += 5.0
    bench = torques(x_des=near)
    bench.step(n=60)
    assert not bench.notices()
    for _ in range(2):
        bench.inputs.x_des = far
        bench.step(n=30)
        (notice,) = bench.notices()
        assert "frame body cannot follow X_BODY_DES, " in notice.text
        full = np.abs(bench.outputs.tau) >= 25.0 * (1.0 - 1e-6)
        joints = bench.module._model.joints.joints
        names = [one for one, at in zip(joints, full, strict=True) if at]
        assert 0 < len(names) < 12
        assert f": the torque of {', '.join(names)} is at its limit" in notice.text
        assert np.abs(bench.outputs.tau).max() <= 25.0
        bench.inputs.x_des = near
        bench.step(n=30)
    turned = BODY.copy()
    turned[:, :3] = rotation(np.array([0.0, 0.0, 3.0]))
    bench.inputs.x_des = turned
    bench.step(n=30)
    (notice,) = bench.notices()
    assert "rad/s^2 are missing" in notice.text


def test_feet_are_set_when_others_stand_and_not_by_how_much() -> None:
    """To set them takes placo microseconds, and an estimate of contact trembles."""
    bench, stood = torques(), []
    bench.step()
    stand = bench.module._stand
    note = lambda stands: (stood.append(stands), stand(stands))  # noqa: E731
    object.__setattr__(bench.module, "_stand", note)
    for contact in ([0.9, 1.0, 0.7, 1.0], [0.9, 0.4, 0.7, 1.0], [1.0, 0.3, 1.0, 1.0]):
        bench.inputs.contact = contact
        bench.step()
    assert stood == [[True, False, True, True]]


def test_joints_too_weak_end_in_error_with_the_feet(tmp_path: Path) -> None:
    weak = (QUADRUPED / "quadruped.urdf").read_text().replace('"25"', '"0.5"')
    (tmp_path / "weak.urdf").write_text(weak)
    before = np.full(12, 0.1)
    told = {"params": {"urdf": "weak.urdf"}, "library": [tmp_path], "tau": before}
    bench = torques(qd=[0.0, 9.0, -9.0] * 4, **told)
    with pytest.raises(MethodError) as caught:
        bench.step()
    assert "keep what stands where it is: lf_foot lh_foot rf_foot rh_foot" in str(
        caught.value
    )
    assert bench.state is State.ERROR
    assert bench.outputs.tau == pytest.approx(before), "nothing was written"


def test_torque_stays_within_what_the_file_allows() -> None:
    far = STAND.copy()
    far[8] += 1.0
    bench = torques(q_ref=far, contact=[1.0, 1.0, 0.0, 1.0], params={"joint_kp": 1e5})
    bench.step(n=60)
    assert np.abs(bench.outputs.tau).max() == pytest.approx(25.0, abs=1e-6)


@pytest.mark.parametrize(
    ("port", "index", "text"),
    [
        *SENSORS[:-1],
        ("x_des", (0, 0), "X_BODY_DES of frame body is not a pose"),
        ("v_des", (0,), "X^_BODY_DES of frame body along x is not finite"),
        ("contact", (1,), "CONTACT_DES of lh_foot is not finite"),
        ("q_ref", (3,), "Q_REF of joint lh_roll is not finite"),
        ("qd_ref", (11,), "Q^_REF of joint rh_knee is not finite"),
    ],
)
def test_a_value_that_is_none_ends_in_error_and_no_torque(
    port: str, index: tuple[int, ...], text: str
) -> None:
    bench = torques(tau=[1.0] * 12)
    bench.step()
    before = bench.outputs.tau.copy()
    was = np.array(getattr(bench.inputs, port))
    spoil(bench, port, index)
    with pytest.raises(MethodError) as caught:
        bench.step()
    assert text in str(caught.value)
    assert bench.outputs.tau == pytest.approx(before)
    setattr(bench.inputs, port, was)
    bench.clear()
    bench.on()
    bench.step()
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9), "and it goes on"


def test_a_posture_keeps_no_memory() -> None:
    """10,000 of them kept 640 KiB: a quaternion of pinocchio each."""
    model, path = FloatingModel("quadruped.urdf", [QUADRUPED]), Path("/proc/self/statm")
    pages = []
    for count in (1000, 10000):
        for _ in range(count):
            model.move(BODY, np.zeros(6), STAND, np.zeros(12))
        pages.append(int(path.read_text().split()[1]))
    assert model.q[:7] == pytest.approx([0.0, 0.0, 0.32, 0.0, 0.0, 0.0, 1.0])
    assert (pages[1] - pages[0]) * resource.getpagesize() < 256 * 1024


def test_gains_are_set_while_the_robot_stands() -> None:
    goal = BODY.copy()
    goal[2, 3] += 0.01
    bench = torques(x_des=goal)
    bench.step(n=60)
    soft = bench.outputs.tau.copy()
    bench.set("kp", "800")
    bench.step()
    assert np.abs(bench.outputs.tau - soft).max() > 0.5
    with pytest.raises(MethodError, match="feet is read when the task is created"):
        bench.set("feet", "lf_foot")


# ------------------------------------------------------------------------ wrong robots

MODULES: list[tuple[Any, dict[str, Any]]] = [
    (Contact, {}),
    (WholeBody, {"body": "body"}),
    (WholeBodyDyn, {"body": "body"}),
]


def said(cls: Any, folder: Path, more: dict[str, Any], **params: Any) -> str:
    told = {"urdf": write_walker(folder, 2, 3), "feet": feet_of(2), **more, **params}
    values = {"ndof": told.pop("ndof", 6), "nfeet": told.pop("nfeet", 2)}
    with pytest.raises(MethodError) as caught:
        Bench(cls, values, params=told, library=[folder])
    return str(caught.value)


@pytest.mark.parametrize(("cls", "more"), MODULES)
@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"feet": ("foot1", "fot2")}, "no frame fot2"),
        ({"feet": ("foot1", "foot1")}, "FEET does not name a foot for each row"),
        ({"feet": ("foot1",)}, "expected 2 different frames, got 1: foot1"),
        ({"ndof": 5}, "got 6: leg1_1 leg1_2 leg1_3 leg2_1 leg2_2 leg2_3"),
        ({"urdf": "other.urdf"}, 'no file "other.urdf"'),
    ],
)
def test_wrong_frames_and_sizes_are_refused_by_name(
    cls: Any, more: dict[str, Any], wrong: dict[str, Any], text: str, tmp_path: Path
) -> None:
    assert text in said(cls, tmp_path, more, **wrong)


@pytest.mark.parametrize("cls", [WholeBody, WholeBodyDyn])
def test_a_body_that_is_no_frame_is_refused_by_name(cls: Any, tmp_path: Path) -> None:
    assert "no frame bdy" in said(cls, tmp_path, {}, body="bdy")
