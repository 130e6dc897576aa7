"""Kinematics from the DH table: against pinocchio, differences, and themselves."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from pbonet.errors import ParameterError
from pbonet.io import (
    FrameStep,
    FreeMotion,
    JointSteps,
    difference,
    fault_of_pose,
    is_rotation,
    rotation,
    turn_of,
)
from pbonet.io.puma560 import PUMA560
from pbonet.modules._dh import Geometry, gap
from pbonet.modules._puma_arm import PumaArm

RNG = np.random.default_rng(315)
POSTURES = RNG.uniform(PUMA560.lower, PUMA560.upper, (1000, 6))
OTHER = np.array([  # an arm that nobody built: offsets and twists everywhere
    (0.3, 0.4, 0.1, 1.1),
    (-0.2, 0.1, 0.5, -0.4),
    (0.1, -0.2, 0.3, 2.0),
    (0.0, 0.3, -0.1, -1.3),
    (1.0, 0.0, 0.2, 0.7),
    (-0.5, 0.15, 0.05, 0.2),
])


class Oracle:
    """The same arm as a chain of pinocchio's joints and fixed placements."""

    def __init__(self, dh: np.ndarray) -> None:
        self.model = pin.Model()
        at, parent = pin.SE3.Identity(), 0
        for k, (theta, d, a, alpha) in enumerate(dh):
            at *= pin.SE3(pin.utils.rotate("z", theta), np.zeros(3))
            parent = self.model.addJoint(parent, pin.JointModelRZ(), at, f"j{k}")
            at = pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, d]))
        frame = pin.Frame("hand", parent, 0, at, pin.FrameType.OP_FRAME)
        self.hand = self.model.addFrame(frame)
        self.data = self.model.createData()

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pose and Jacobian in the base's axes."""
        jacobian = pin.computeFrameJacobian(
            self.model, self.data, q, self.hand, pin.LOCAL_WORLD_ALIGNED
        )
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.hand].homogeneous[:3], jacobian


@pytest.fixture(scope="module")
def arm() -> PumaArm:
    return PumaArm(PUMA560.dh, PUMA560.lower, PUMA560.upper)


@pytest.fixture(scope="module")
def geometry() -> Geometry:
    return Geometry(PUMA560.dh)


# --------------------------------------------------------------------------- forward


@pytest.mark.slow
@pytest.mark.parametrize("dh", [PUMA560.dh, OTHER], ids=["puma", "other"])
def test_pose_and_jacobian_are_pinocchio_s(dh: np.ndarray) -> None:
    geometry, oracle = Geometry(dh), Oracle(dh)
    for q in POSTURES:
        for mine, its in zip(geometry.jacobian(q), oracle(q), strict=True):
            assert np.abs(mine - its).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("dh", [PUMA560.dh, OTHER], ids=["puma", "other"])
def test_jacobian_is_the_derivative_of_the_pose(dh: np.ndarray) -> None:
    geometry, h = Geometry(dh), 1e-6
    for q in POSTURES:
        _, jacobian = geometry.jacobian(q)
        for k, step in enumerate(h * np.eye(6)):
            slope = difference(geometry.pose(q + step), geometry.pose(q - step))
            assert np.abs(slope / (2.0 * h) - jacobian[:, k]).max() < 1e-8


def test_any_number_of_joints_will_do() -> None:
    """Two links of 1 m and 0.5 m in a plane: the textbook's Jacobian."""
    geometry = Geometry(np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.5, 0.0]]))
    pose, jacobian = geometry.jacobian(np.array([0.0, np.pi / 2]))
    assert pose[:, 3] == pytest.approx([1.0, 0.5, 0.0])
    assert jacobian[:2] == pytest.approx(np.array([[-0.5, -0.5], [1.0, 0.0]]))
    assert jacobian[5] == pytest.approx([1.0, 1.0])
    assert jacobian[2:5] == pytest.approx(np.zeros((3, 2)))


# -------------------------------------------------------------------------- rotations


def turns(rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield turns of all sizes about any axis, many near none, half one, and axes."""
    near = 10.0 ** np.arange(-16.0, 0.0)
    for angle in (0.0, 0.3, 0.5 * np.pi, 2.0, np.pi, *near, *(np.pi - near)):
        for axis in (*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))):
            yield angle * axis / np.linalg.norm(axis)


def test_turns_rotations_and_displacements_are_scipy_s() -> None:
    other = Rotation.random(random_state=3).as_matrix()
    for turn in turns(np.random.default_rng(7)):
        matrix = Rotation.from_rotvec(turn).as_matrix()
        assert is_rotation(matrix)
        assert np.abs(rotation(turn) - matrix).max() < 1e-14
        found = turn_of(matrix)
        assert np.linalg.norm(found) < np.pi + 1e-15
        assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(turn), abs=1e-12)
        assert np.abs(Rotation.from_rotvec(found).as_matrix() - matrix).max() < 1e-11
        pose = np.column_stack((other, [0.1, 0.2, 0.3]))
        wanted = np.column_stack((matrix @ other, [0.3, 0.1, 0.2]))
        step = difference(wanted, pose)
        assert step[:3] == pytest.approx([0.2, -0.1, -0.1])
        moved = Rotation.from_rotvec(step[3:]).as_matrix() @ other
        assert np.abs(moved - wanted[:, :3]).max() < 1e-11


def test_a_free_base_is_placed_as_pinocchio_places_it() -> None:
    """Signs of the quaternion, too: all branches, near half turns and none."""
    rng = np.random.default_rng(8)
    q, v = np.zeros(9), np.zeros(8)
    motion = FreeMotion(q, v)
    for turn in turns(rng):
        matrix = Rotation.from_rotvec(turn).as_matrix()
        place, velocity = rng.normal(size=(2, 3))
        pose = np.column_stack((matrix, place))
        assert motion.set(pose, np.r_[velocity, place], velocity[:2], place[:2])
        wanted = pin.SE3ToXYZQUAT(pin.SE3(matrix, place))
        assert np.abs(q[:7] - wanted).max() < 1e-15
        assert np.abs(v[:3] - matrix.T @ velocity).max() < 1e-14
        assert np.abs(v[3:6] - matrix.T @ place).max() < 1e-14
        assert (q[7:].tolist(), v[6:].tolist()) == (
            velocity[:2].tolist(),
            place[:2].tolist(),
        )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_no_pose_has_an_element_that_is_no_number(bad: float) -> None:
    still = np.zeros(6), np.zeros(1), np.zeros(1)
    motion = FreeMotion(np.zeros(8), np.zeros(7))
    for row, column in product(range(3), range(4)):
        pose = np.eye(3, 4)
        assert motion.set(pose, *still)
        assert not fault_of_pose(pose)
        pose[row, column] = bad
        assert not motion.set(pose, *still)
        assert fault_of_pose(pose) == "it has elements that are not finite"
        assert is_rotation(pose[:, :3]) is (column == 3)
    assert not motion.set(np.eye(3, 4), np.full(6, bad), *still[1:])


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1.0])
def test_a_goal_that_is_taken_at_once_is_a_pose(bad: float) -> None:
    wanted = np.eye(3, 4)
    wanted[:, 3] = 0.1, 0.2, 0.3
    step = FrameStep(wanted)
    assert step.take()
    assert (step.goal[:3] == wanted).all()
    assert step.goal[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    for row, column in product(range(3), range(4)):
        good, wanted[row, column] = wanted[row, column], bad
        fits = good == bad or (column == 3 and bool(np.isfinite(bad)))
        assert step.take() == fits
        wanted[row, column] = good


JOINTS = 40


def joints(speed: float = 2.0) -> tuple[JointSteps, np.ndarray, np.ndarray]:
    """Return steps of many joints from -1 to 1 rad, with q and velocities."""
    q, qd = np.linspace(-0.5, 0.5, JOINTS), np.zeros(JOINTS)
    ones = np.ones(JOINTS)
    return JointSteps(q, np.zeros(JOINTS), qd, -ones, ones, speed * ones), q, qd


@pytest.mark.parametrize("accel", [5.0, 80.0, np.inf])
def test_joints_that_are_driven_anyhow_stop_before_their_limits(accel: float) -> None:
    steps, q, qd = joints()
    rng = np.random.default_rng(2)
    wish = np.sign(rng.normal(size=JOINTS))
    reached = 0.0
    for dt in np.where(rng.random(3000) < 0.1, 0.009, 0.003):  # some are missed
        wish = np.where(rng.random(JOINTS) < 0.01, -wish, wish)
        assert steps.limit(accel, dt)
        high, low = steps.room[:JOINTS], -steps.room[JOINTS:]
        assert (low <= high + 1e-15).all()
        before = qd.copy()
        steps.take(np.concatenate((np.zeros(6), np.where(wish > 0, high, low) - q)), dt)
        assert np.abs(qd - before).max() <= accel * dt * (1 + 1e-9)
        assert np.abs(qd).max() <= 2.0 * (1 + 1e-9)
        reached = max(reached, np.abs(q).max())
    assert reached == pytest.approx(1.0, abs=1e-9), "and not long before"


def test_a_joint_beyond_its_limit_comes_back_if_a_step_takes_it() -> None:
    steps, q, _ = joints()
    q[0], q[-1] = -1.0 - 0.005, 1.0 + 0.005
    assert steps.limit(1e9, 0.003)
    assert -steps.room[JOINTS] == pytest.approx(-1.0)
    assert steps.room[JOINTS - 1] == pytest.approx(1.0)
    q[-1] = 1.0 + 0.007
    assert not steps.limit(1e9, 0.003)


def test_limits_of_another_number_of_joints_are_refused() -> None:
    three, two = np.zeros(3), np.zeros(2)
    with pytest.raises(ValueError, match="limits are not those of the joints"):
        JointSteps(three, three.copy(), three.copy(), two, three, three)
    with pytest.raises(ValueError, match="references are not those of the joints"):
        JointSteps(three, two, three.copy(), three, three, three)


def test_difference_takes_one_pose_to_the_other(geometry: Geometry) -> None:
    for one, two in zip(POSTURES[:100], POSTURES[100:200], strict=True):
        a, b = geometry.pose(one), geometry.pose(two)
        step = difference(b, a)
        assert rotation(step[3:]) @ a[:, :3] == pytest.approx(b[:, :3], abs=1e-7)
        assert a[:, 3] + step[:3] == pytest.approx(b[:, 3])
        size = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
        assert gap(b, a) == pytest.approx(size, abs=1e-7)


@pytest.mark.parametrize(
    "matrix", [np.zeros((3, 3)), 1.01 * np.eye(3), np.diag([1.0, 1.0, -1.0])]
)
def test_what_is_no_rotation_is_seen(matrix: np.ndarray) -> None:
    assert not is_rotation(matrix)


# --------------------------------------------------------------------------- inverse


@pytest.mark.slow
def test_inverse_after_forward_is_the_posture(arm: PumaArm, geometry: Geometry) -> None:
    for q in POSTURES:
        found, why = arm.solve(geometry.pose(q), near=q)
        assert not why
        assert found == pytest.approx(q, abs=1e-9)


@pytest.mark.slow
def test_forward_after_inverse_is_the_pose(arm: PumaArm, geometry: Geometry) -> None:
    """From wherever the arm is: the posture may be another one, the pose is not."""
    others = 0
    for q, near in zip(POSTURES, POSTURES[::-1], strict=True):
        pose = geometry.pose(q)
        found, _ = arm.solve(pose, near)
        assert found is not None
        assert geometry.pose(found) == pytest.approx(pose, abs=1e-9)
        assert np.all((found >= PUMA560.lower) & (found <= PUMA560.upper))
        assert np.abs(found - near).max() <= np.abs(q - near).max() + 1e-9
        others += bool(np.abs(found - q).max() > 1e-6)
    assert others > 500, "most poses have several solutions"


def test_tool_base_and_offsets_of_the_table_count() -> None:
    dh = PUMA560.dh.copy()
    dh[:, 0] = [0.1, -0.2, 0.3, 0.4, -0.5, 0.6]
    dh[0, 1], dh[1, 1], dh[5, 1] = 0.66, 0.24, 0.1
    arm, geometry = PumaArm(dh, PUMA560.lower, PUMA560.upper), Geometry(dh)
    for q in POSTURES[:100]:
        found, _ = arm.solve(geometry.pose(q), near=q)
        assert found == pytest.approx(q, abs=1e-9)


def test_in_the_wrist_singularity_joint_4_stays(
    arm: PumaArm, geometry: Geometry
) -> None:
    q = np.array([0.1, 0.8, -3.0, 0.7, 0.0, 0.2])
    near = np.array([0.1, 0.8, -3.0, 0.5, 0.0, 0.4])  # the same pose
    found, _ = arm.solve(geometry.pose(q), near)
    assert found == pytest.approx(near, abs=1e-7)


def test_whole_turns_follow_where_the_arm_is(arm: PumaArm, geometry: Geometry) -> None:
    q = np.array([0.1, 0.8, -3.0, 0.7, 0.5, 4.0])
    found, _ = arm.solve(geometry.pose(q), near=q)
    assert found is not None
    assert found[5] == pytest.approx(4.0)
    found, _ = arm.solve(geometry.pose(q), near=q - [0, 0, 0, 0, 0, 6.0])
    assert found is not None
    assert found[5] == pytest.approx(4.0 - 2.0 * np.pi)


def test_no_solution_says_why(arm: PumaArm, geometry: Geometry) -> None:
    pose = geometry.pose(POSTURES[0])
    far = pose.copy()
    far[:, 3] = [2.0, 0.0, 0.0]
    assert arm.solve(far, POSTURES[0]) == (
        None,
        "out of reach: the wrist would be 2.000 m from the shoulder, where the arm"
        " reaches 0.877 m",
    )
    far[:, 3] = [0.01, 0.0, 0.4]  # between shoulder and axis
    assert "out of reach" in arm.solve(far, POSTURES[0]).why
    narrow = PumaArm(PUMA560.dh, np.full(6, -0.01), np.full(6, 0.01))
    assert narrow.solve(pose, np.zeros(6)) == (
        None,
        "only postures beyond the joint limits reach it",
    )


def test_determinant_is_the_product_of_the_three_distances(
    arm: PumaArm, geometry: Geometry
) -> None:
    ratios = [
        abs(np.linalg.det(geometry.jacobian(q)[1]))
        / np.prod([*arm.singular(q).values()])
        for q in POSTURES[:300]
    ]
    assert np.ptp(ratios) < 1e-6 * ratios[0]


@pytest.mark.parametrize(
    ("change", "got"),
    [
        ((slice(5), slice(None), None), "5 joints"),
        ((1, 3, 0.1), "twists [90.0"),
        ((4, 1, 0.1), "a [0"),
        ((1, 2, 0.0), "a [0"),
    ],
)
def test_an_arm_that_is_built_otherwise_is_refused(
    change: tuple[object, object, float | None], got: str
) -> None:
    row, column, value = change
    dh = PUMA560.dh.copy()
    if value is None:
        dh = dh[row]
    else:
        dh[row, column] = value
    with pytest.raises(ParameterError, match="another wrist or shoulder") as caught:
        PumaArm(dh, PUMA560.lower, PUMA560.upper)
    assert caught.value.got.replace("[ 90.", "[90.0").startswith(got)
