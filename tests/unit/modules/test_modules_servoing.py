"""The modules of visual servoing on a bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbonet.modules
from pbonet import Params
from pbonet.config import read_rmod
from pbonet.config.library import Library
from pbonet.errors import MethodError, ParameterError
from pbonet.io import rotation
from pbonet.io.puma560 import PUMA560
from pbonet.master.subsystem import Subsystem
from pbonet.modules._dh import Geometry, gap, scale
from pbonet.modules.kinematics.damped_ls import DampedLS
from pbonet.modules.kinematics.forward_kin import ForwardKin
from pbonet.modules.kinematics.puma_inv_kin import PumaInvKin
from pbonet.modules.signals.integrator import Integrator
from pbonet.modules.signals.reference_integrator import ReferenceIntegrator
from pbonet.modules.trajectories.visual_target import VisualTarget
from pbonet.pbo import decode_params
from pbonet.testing import Bench

LIBRARY = Path(pbonet.modules.__file__).parent
EXAMPLE = LIBRARY.parents[1] / "examples" / "servoing"
GEOMETRY = Geometry(PUMA560.dh)
LIMITS = {"lower": tuple(PUMA560.lower), "upper": tuple(PUMA560.upper)}
POSTURE = np.array([-0.25, 0.785, -3.14, -1.05, 0.61, 0.0])


def configured(file: Path) -> Params:
    """Return the parameters that an RMOD gives its module."""
    rmod = read_rmod(file)
    return decode_params(Library().load(rmod.module).cls, rmod.local)


# ------------------------------------------------------------------------ forward_kin


def forward_kin(**params: object) -> Bench[ForwardKin]:
    return Bench(ForwardKin, params=params, ndof=6, dh=PUMA560.dh, freq=100)


def test_pose_and_jacobian_are_there_as_soon_as_it_is_on() -> None:
    bench = forward_kin()
    bench.inputs.q = POSTURE
    bench.on()
    pose, jacobian = GEOMETRY.jacobian(POSTURE)
    assert bench.outputs.x == pytest.approx(pose)
    assert bench.outputs.jacobian == pytest.approx(jacobian)


def test_sigma_says_how_far_a_singularity_is() -> None:
    bench = forward_kin()
    seen = []
    for bend in (0.8, 0.4, 0.1, 0.01, 0.0):
        bench.inputs.q = [0.0, 0.785, -3.14, 0.0, bend, 0.0]
        if not seen:
            bench.on()
        bench.step()
        seen.append(bench.outputs.sigma)
    assert seen == sorted(seen, reverse=True)
    assert seen[-1] == pytest.approx(0.0, abs=1e-12)
    assert seen[-2] == pytest.approx(seen[-3] / 10.0, rel=0.02)


def test_a_longer_length_counts_positions_less() -> None:
    short, long = forward_kin(length=0.1), forward_kin(length=1.0)
    for bench in (short, long):
        bench.inputs.q = POSTURE
        bench.on()
    assert long.outputs.sigma < short.outputs.sigma
    short.set("length", 1.0)
    short.step()
    assert short.outputs.sigma == pytest.approx(long.outputs.sigma)


def test_a_new_tool_is_taken_up_when_the_constant_changes() -> None:
    bench = forward_kin()
    bench.inputs.q = POSTURE
    bench.on()
    before = bench.outputs.x.copy()
    dh = PUMA560.dh.copy()
    dh[5, 1] = 0.1
    bench.reinit(dh=dh)
    bench.step()
    assert bench.outputs.x[:, 3] == pytest.approx(before[:, 3] + 0.1 * before[:, 2])


# ----------------------------------------------------------------------- puma_inv_kin


def inverse(**values: Any) -> Bench[PumaInvKin]:
    bench = Bench(
        PumaInvKin,
        params=LIMITS | values,
        ndof=6,
        dh=PUMA560.dh,
        x=GEOMETRY.pose(POSTURE),
        q_ref=POSTURE,
        freq=100,
    )
    bench.on()
    return bench


def test_it_reaches_the_pose() -> None:
    bench = inverse()
    goal = POSTURE + np.array([0.1, 0.1, -0.1, 0.2, 0.1, -0.2])
    bench.inputs.x = GEOMETRY.pose(goal)
    bench.step(n=60)
    assert bench.outputs.q_ref == pytest.approx(goal, abs=1e-9)
    assert bench.notices() == []


def test_it_takes_over_without_a_step() -> None:
    """Q_REF stands elsewhere when it is turned on, as after another controller."""
    bench = inverse(fade=0.5)
    bench.off()
    start = POSTURE + 0.3
    bench.outputs.q_ref = start
    bench.on()
    assert np.array_equal(bench.outputs.q_ref, start)
    seen = [start]
    for _ in range(60):
        bench.step()
        seen.append(bench.outputs.q_ref.copy())
    assert np.abs(np.diff(seen, axis=0)).max() < 0.3 * 1.5 / 0.5 * 0.01 * 1.01
    assert seen[-1] == pytest.approx(POSTURE, abs=1e-9)


def test_a_pose_out_of_reach_is_told_once_and_holds_the_reference() -> None:
    bench = inverse()
    bench.step(n=60)
    far = GEOMETRY.pose(POSTURE)
    far[0, 3] += 1.0
    bench.inputs.x = far
    bench.step(n=20)
    far[0, 3] += 0.1  # still out of reach: that is not news
    bench.inputs.x = far
    bench.step()
    (notice,) = bench.notices()
    assert notice.text.startswith("no solution, out of reach: the wrist would be 1.")
    assert notice.text.endswith("Q_REF does not change")
    assert bench.outputs.q_ref == pytest.approx(POSTURE, abs=1e-9)
    bench.inputs.x = GEOMETRY.pose(POSTURE + 0.1)
    bench.step()
    assert bench.outputs.q_ref == pytest.approx(POSTURE, abs=1e-3), "no step either"
    bench.step(n=60)
    assert bench.outputs.q_ref == pytest.approx(POSTURE + 0.1, abs=1e-9)
    bench.inputs.x = far
    bench.step()
    assert len(bench.notices()) == 1, "a second time is news"


def test_what_is_no_pose_is_told_and_holds_the_reference() -> None:
    bench = inverse()
    bench.inputs.x = np.zeros((3, 4))
    bench.step(n=3)
    (notice,) = bench.notices()
    assert "X_DES is not a pose" in notice.text
    assert np.array_equal(bench.outputs.q_ref, POSTURE)


@pytest.mark.parametrize(
    ("name", "posture"),
    [
        ("wrist", [0.0, 0.785, -3.14, 0.0, 0.05, 0.0]),
        ("elbow", [0.0, 0.785, -1.57, 0.0, 0.6, 0.0]),
        ("shoulder", [0.0, 2.3, -3.14, 0.0, 0.6, 0.0]),
    ],
)
def test_a_singularity_that_is_near_is_named_once(
    name: str, posture: list[float]
) -> None:
    bench = inverse()
    away = np.array([0.0, 0.785, -2.8, 0.0, 0.6, 0.0])
    for goal in (posture, away, posture):
        bench.inputs.x = GEOMETRY.pose(np.array(goal))
        bench.step(n=5)
    texts = [notice.text for notice in bench.notices()]
    assert len(texts) == 2
    assert all(f"near its {name} singularity" in text for text in texts)


def test_limits_that_leave_no_room_are_refused() -> None:
    with pytest.raises(MethodError) as caught:
        inverse(lower=(1.0,), upper=(1.0,))
    assert "the joint limits leave a joint no room" in str(caught.value)


def test_limits_in_the_rmods_are_the_arm_s() -> None:
    for name in ("puma_inv_kin", "qrint"):
        given: Any = configured(Library().find_rmod(name))
        assert given.lower == pytest.approx(PUMA560.lower, abs=1e-6)
        assert given.upper == pytest.approx(PUMA560.upper, abs=1e-6)


# -------------------------------------------------------------------------- damped_ls


def damped(q: np.ndarray, wanted: np.ndarray, **params: object) -> Bench[DampedLS]:
    """Return one that is on at `q`, where the hand shall have the velocity wanted."""
    pose, jacobian = GEOMETRY.jacobian(q)
    bench = Bench(
        DampedLS,
        params=params,
        ndof=6,
        x_des=pose,
        x=pose,
        v_des=wanted,
        jacobian=jacobian,
        freq=100,
    )
    bench.on()
    return bench


def test_away_from_singularities_the_hand_moves_as_wanted() -> None:
    q = np.array([0.2, 0.785, -2.6, 0.3, 0.9, 0.1])
    wanted = np.array([0.1, -0.2, 0.05, 0.3, 0.2, -0.4])
    bench = damped(q, wanted)
    moved = GEOMETRY.jacobian(q)[1] @ bench.outputs.qd
    assert moved == pytest.approx(wanted, abs=1e-12)


def test_an_error_of_the_pose_is_driven_to_zero() -> None:
    q = np.array([0.2, 0.785, -2.6, 0.3, 0.9, 0.1])
    goal = GEOMETRY.pose(q + 0.05)
    bench = damped(q, np.zeros(6), gain=4.0)
    bench.inputs.x_des = goal
    gaps = []
    for _ in range(200):
        bench.step()
        q = q + 0.01 * bench.outputs.qd
        bench.inputs.x, bench.inputs.jacobian = GEOMETRY.jacobian(q)
        gaps.append(gap(goal, bench.inputs.x)[1])
    assert gaps[-1] < 1e-4
    assert gaps[100] / gaps[0] == pytest.approx(np.exp(-4.0), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.1, 0.2, 0.4])
def test_joint_velocity_is_bounded_everywhere_and_at_singularities(
    damping: float,
) -> None:
    """The bound of the class's docstring; without damping there is none."""
    rng = np.random.default_rng(9)
    bound = np.hypot(1.0 / (2.0 * damping), 1.0 / 0.2)
    bench = damped(POSTURE, np.zeros(6), damping=damping, sigma=0.2, linear=9.0,
                   angular=9.0, joint_accel=1e9)  # fmt: skip
    weights, reached, undamped = scale(0.2), 0.0, 0.0
    for bend in np.concatenate((np.geomspace(1e-9, 1.0, 500), np.zeros(10))):
        q = rng.uniform(PUMA560.lower, PUMA560.upper)
        q[4] = bend
        jacobian = GEOMETRY.jacobian(q)[1]
        # the worst direction there is: that of the smallest singular value
        u, s, _ = np.linalg.svd(weights[:, None] * jacobian)
        wish = u[:, -1] / weights
        bench.inputs.jacobian, bench.inputs.v_des = jacobian, wish
        bench.step()
        speed = np.linalg.norm(bench.outputs.qd)
        assert speed <= bound * (1.0 + 1e-9)
        reached = max(reached, speed)
        undamped = max(undamped, 1.0 / max(s[-1], 1e-12))
    assert reached > 0.8 * bound, "and the bound is no idle one"
    assert undamped > 1e6


def test_damping_sets_in_without_a_step() -> None:
    speeds = []
    for bend in np.linspace(0.0, 0.6, 301):
        q = np.array([0.0, 0.785, -3.14, 0.0, bend, 0.0])
        wanted = np.array([0.0, 0.0, 0.0, 0.3, 0.3, 0.3])
        speeds.append(damped(q, wanted).outputs.qd.copy())
    assert np.abs(np.diff(speeds, axis=0)).max() < 0.05


def test_in_the_singularity_it_still_moves_where_it_can() -> None:
    q = np.array([0.0, 0.785, -3.14, 0.0, 0.0, 0.0])
    jacobian = GEOMETRY.jacobian(q)[1]
    wanted = jacobian @ np.array([0.1, 0.1, -0.1, 0.2, 0.1, 0.2])
    bench = damped(q, wanted, sigma=0.05)
    assert jacobian @ bench.outputs.qd == pytest.approx(wanted, abs=1e-9)


def test_a_singular_arm_is_told_once_until_it_can_follow_again() -> None:
    """As when it is stretched towards a goal out of reach."""
    singular, free = (np.array([0.0, 0.785, -3.14, 0.0, b, 0.0]) for b in (0.0, 0.6))
    bench = damped(singular, np.zeros(6))
    stretched = bench.inputs.x_des.copy(), bench.inputs.jacobian.copy()
    u, s, _ = np.linalg.svd(scale(0.2)[:, None] * bench.inputs.jacobian)
    bench.inputs.v_des = 0.1 * u[:, -1] / scale(0.2)
    bench.step(n=3)
    (notice,) = bench.notices()
    assert "cannot follow X_DES" in notice.text
    assert f"singular value of {s[-1]:.2g} in J_MEZ" in notice.text
    lost = bench.inputs.v_des - bench.inputs.jacobian @ bench.outputs.qd
    told = 0.2 * np.abs(scale(0.2) * lost).max()
    assert f"{told:.2g} m/s are missing" in notice.text
    bench.inputs.v_des = np.zeros(6)  # nothing is missing of no velocity
    bench.step()
    bench.inputs.v_des = 0.1 * u[:, -1] / scale(0.2)
    bench.step()
    assert len(bench.notices()) == 1, "it came again"
    bench.inputs.x_des, bench.inputs.jacobian = GEOMETRY.jacobian(free)
    bench.inputs.x = bench.inputs.x_des
    bench.step(n=3)
    assert not bench.notices()
    bench.inputs.x_des, bench.inputs.jacobian = stretched
    bench.inputs.x = bench.inputs.x_des
    bench.step(n=3)
    assert len(bench.notices()) == 1, "and could follow meanwhile"


def test_the_hand_is_asked_for_no_more_than_its_limits() -> None:
    q = np.array([0.2, 0.785, -2.6, 0.3, 0.9, 0.1])
    wanted = np.array([3.0, 0.0, 4.0, 0.0, 6.0, 8.0])
    bench = damped(q, wanted, linear=0.5, angular=1.0)
    moved = GEOMETRY.jacobian(q)[1] @ bench.outputs.qd
    assert moved == pytest.approx([0.3, 0.0, 0.4, 0.0, 0.6, 0.8], abs=1e-12)


FAR = np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 5.0])


def test_a_goal_that_jumps_is_approached_by_the_joints_acceleration() -> None:
    q = np.array([0.2, 0.785, -2.6, 0.3, 0.9, 0.1])
    bench = damped(q, np.zeros(6), linear=9.0, joint_accel=20.0)
    whole = damped(q, np.zeros(6), linear=9.0, joint_accel=1e9)
    for one in (bench, whole):
        one.inputs.x_des = one.inputs.x + FAR
    whole.step()
    found = [bench.outputs.qd.copy()]
    for _ in range(300):
        bench.step()
        found.append(bench.outputs.qd.copy())
    steps = np.abs(np.diff(found, axis=0)).max(axis=1)
    assert steps[0] == pytest.approx(20.0 * 0.01)
    assert steps.max() == pytest.approx(20.0 * 0.01)
    assert found[-1] == pytest.approx(whole.outputs.qd), "the law has it then"
    share = found[1] / whole.outputs.qd
    assert share == pytest.approx(np.full(6, share[0])), "all by the same share"


def test_it_begins_with_the_velocity_of_the_goal_alone() -> None:
    q = np.array([0.2, 0.785, -2.6, 0.3, 0.9, 0.1])
    pose, jacobian = GEOMETRY.jacobian(q)
    wanted = np.array([0.1, -0.2, 0.05, 0.3, 0.2, -0.4])
    far = pose + FAR
    bench = Bench(DampedLS, ndof=6, x_des=far, x=pose, v_des=wanted, jacobian=jacobian)
    bench.on()
    assert jacobian @ bench.outputs.qd == pytest.approx(wanted, abs=1e-12)
    assert bench.inputs.v_des == pytest.approx(wanted), "which is not its to change"


def test_it_goes_on_from_the_velocity_that_was_there() -> None:
    q = np.array([0.2, 0.785, -2.6, 0.3, 0.9, 0.1])
    pose, jacobian = GEOMETRY.jacobian(q)
    there = np.array([0.5, -0.4, 0.3, 0.0, 0.2, -0.1])
    bench = Bench(DampedLS, ndof=6, x_des=pose + FAR, x=pose, jacobian=jacobian,
                  qd=there, freq=100)  # fmt: skip
    bench.on(handover=True)
    assert bench.outputs.qd == pytest.approx(there, abs=0.0)
    bench.step()
    assert np.abs(bench.outputs.qd - there).max() == pytest.approx(20.0 * 0.01)


@pytest.mark.parametrize("delay", [0, 1])
def test_the_hand_arrives_at_a_low_frequency(delay: int) -> None:
    """Also with a pose that was measured a cycle before."""
    q = np.array([0.2, 0.785, -2.6, 0.3, 0.9, 0.1])
    bench = damped(q, np.zeros(6))
    bench.inputs.x_des = GEOMETRY.pose(q + 0.05)
    past = [q] * (1 + delay)
    for _ in range(60):
        bench.inputs.x, bench.inputs.jacobian = GEOMETRY.jacobian(past[-1 - delay])
        bench.step(dt=1.0)
        past.append(past[-1] + bench.outputs.qd)
    assert GEOMETRY.pose(past[-1]) == pytest.approx(bench.inputs.x_des, abs=1e-6)


def test_what_is_no_pose_stops_the_joints_and_is_told_once() -> None:
    bench = damped(POSTURE, np.ones(6))
    bench.inputs.x_des = np.zeros((3, 4))
    bench.step(n=3)
    (notice,) = bench.notices()
    assert "X_DES is not a pose" in notice.text
    assert np.array_equal(bench.outputs.qd, np.zeros(6))
    bench.inputs.x_des = GEOMETRY.pose(POSTURE)
    bench.step()
    assert np.abs(bench.outputs.qd).max() > 0.0


def test_off_leaves_no_velocity_but_to_a_successor() -> None:
    for handover in (False, True):
        bench = damped(POSTURE, np.ones(6))
        before = bench.outputs.qd.copy()
        bench.off(handover=handover)
        assert np.array_equal(bench.outputs.qd, before * handover)


def test_a_redundant_arm_takes_the_smallest_joint_velocities() -> None:
    dh = np.vstack((PUMA560.dh, [0.1, 0.2, 0.3, 0.5]))
    q = np.linspace(0.3, 1.5, 7)
    pose, jacobian = Geometry(dh).jacobian(q)
    wanted = np.array([0.1, 0.0, 0.1, 0.0, 0.1, 0.0])
    bench = Bench(DampedLS, params={"sigma": 1e-6}, ndof=7, x_des=pose, x=pose,
                  v_des=wanted, jacobian=jacobian)  # fmt: skip
    bench.on()
    assert bench.outputs.qd == pytest.approx(np.linalg.pinv(jacobian) @ wanted)


# ------------------------------------------------------------------------- integrator


def integrator(**params: object) -> Bench[Integrator]:
    given = {"lower": (-1.0,), "upper": (1.0,)} | params
    return Bench(Integrator, params=given, ndof=2, z=[0.5, -0.5], freq=100)


def test_integral_goes_on_from_where_it_stands_and_stops_at_the_limits() -> None:
    bench = integrator()
    bench.inputs.z_dot = [0.1, -1.0]
    bench.on()
    assert bench.outputs.z == pytest.approx([0.5, -0.5])
    bench.step(n=30)
    assert bench.outputs.z == pytest.approx([0.53, -0.8])
    bench.step(n=30)
    assert bench.outputs.z == pytest.approx([0.56, -1.0])
    bench.inputs.z_dot = [0.0, 1.0]
    bench.step(n=10)
    assert bench.outputs.z[1] == pytest.approx(-0.9), "at once: nothing was wound up"


def test_a_missed_cycle_is_a_longer_one() -> None:
    bench = integrator()
    bench.inputs.z_dot = [1.0, 0.0]
    bench.on()
    bench.step(0.03)
    assert bench.outputs.z[0] == pytest.approx(0.53)


def test_limits_may_be_set_and_do_not_pull() -> None:
    bench = integrator()
    bench.inputs.z_dot = [1.0, -1.0]
    bench.on()
    bench.set("upper", 0.2)
    bench.step(n=10)
    assert bench.outputs.z == pytest.approx([0.5, -0.6])
    with pytest.raises((MethodError, ParameterError), match="limits leave no room"):
        bench.set("upper", -2.0)


# --------------------------------------------------------------- reference_integrator


def reference(z: float = 0.0, **params: object) -> Bench[ReferenceIntegrator]:
    given = {"lower": (-1.0,), "upper": (1.0,), "lead": (0.1,)} | params
    bench = Bench(ReferenceIntegrator, params=given, ndof=1, z=[z], freq=100)
    bench.on()
    assert bench.outputs.z.tolist() == [z], "bumpless"
    return bench


def test_a_reference_that_is_followed_is_the_integral_within_its_limits() -> None:
    bench = reference()
    time = np.arange(1, 201) * 0.01
    for t in time:
        bench.inputs.z_mez = bench.outputs.z
        bench.inputs.z_dot = [np.cos(5.0 * t)]
        bench.step()
        wanted = 0.01 * np.cos(5.0 * time[: round(t * 100)]).sum()
        assert bench.outputs.z[0] == pytest.approx(wanted, abs=1e-9)
    for _ in range(200):
        bench.inputs.z_mez = bench.outputs.z
        bench.inputs.z_dot = [2.0]
        bench.step()
    assert bench.outputs.z.tolist() == [1.0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_reference_that_is_not_followed_waits_and_comes_back_at_once(sign) -> None:
    bench = reference()
    bench.inputs.z_dot = [0.5 * sign]
    bench.step(n=500)
    assert bench.outputs.z[0] == pytest.approx(0.1 * sign, abs=1e-9)
    bench.inputs.z_dot = [-0.5 * sign]
    bench.step(n=10)
    assert bench.outputs.z[0] == pytest.approx(0.05 * sign, abs=1e-9)


def test_a_reference_that_begins_far_away_is_not_pulled() -> None:
    bench = reference(0.7)
    bench.inputs.z_dot = [1.0]
    bench.step()
    assert bench.outputs.z.tolist() == [0.7]
    bench.inputs.z_dot = [-1.0]
    bench.step()
    assert bench.outputs.z[0] == pytest.approx(0.69)
    bench.set("lead", 1.0)
    bench.inputs.z_dot = [1.0]
    bench.step()
    assert bench.outputs.z[0] == pytest.approx(0.7)


def test_an_arm_that_was_in_stable_goes_to_its_target_and_not_beyond() -> None:
    """The target goes on meanwhile; then the arm has gravity compensated again."""
    with Subsystem(EXAMPLE / "damped.job", virtual=True) as arm:
        arm.start()
        arm.wait(1.0)
        arm.kill("grav_comp")
        arm.wait(3.0)
        arm.spawn("grav_comp", "arm1")
        arm.on("grav_comp")
        arm.wait(2.0)
        arm.finish()
        recording = arm.simulation.recording
    held, steps = recording.arrays("puma_pidg"), recording.arrays("qrint")
    seen = np.searchsorted(held["release_ns"], steps["release_ns"], side="right") - 1
    lead = np.abs(steps["Q_REF"] - held["Q_MEZ"][seen])
    assert lead.max() == pytest.approx(0.1, abs=0.01), "it would be 2.4 rad"
    time = (held["release_ns"] - held["release_ns"][0]) * 1e-9
    assert np.abs(held["Q^_MEZ"][time > 5.0]).max() < 0.3, "it is there"
    place = recording.arrays("forward_kin")["X_MEZ"].reshape(-1, 3, 4)[:, :, 3]
    path = np.linalg.norm(np.diff(place, axis=0), axis=1).sum()
    assert path < 1.2 * np.linalg.norm(place[-1] - place[0]), "without a detour"


# ---------------------------------------------------------------------- visual_target


def target(**params: object) -> Bench[VisualTarget]:
    given = {
        "time": (0.0, 2.0),
        "position": (0.0, 0.0, 0.0, 1.0, 2.0, 0.0),
        "angles": (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    } | params
    bench = Bench(VisualTarget, params=given, freq=25)
    bench.on()
    return bench


def test_target_goes_from_pose_to_pose_and_rests() -> None:
    bench = target()
    assert bench.outputs.x == pytest.approx(np.eye(4)[:3])
    bench.step(n=25)  # half way
    assert bench.outputs.x[:, 3] == pytest.approx([0.5, 1.0, 0.0])
    assert bench.outputs.x[:, :3] == pytest.approx(rotation(np.array([0, 0, 0.5])))
    assert bench.outputs.v == pytest.approx(1.875 / 2.0 * np.array([1, 2, 0, 0, 0, 1]))
    bench.step(n=50)
    assert bench.outputs.x[:, 3] == pytest.approx([1.0, 2.0, 0.0])
    assert np.array_equal(bench.outputs.v, np.zeros(6))


def test_its_velocity_is_the_derivative_of_its_pose() -> None:
    bench = target()
    poses, velocities = [], []
    for _ in range(200):
        bench.step(0.01)
        poses.append(bench.outputs.x.copy())
        velocities.append(bench.outputs.v.copy())
    slope = (np.array(poses[2:]) - np.array(poses[:-2]))[:, :, 3] / 0.02
    assert slope == pytest.approx(np.array(velocities)[1:-1, :3], abs=1e-3)


def test_it_is_seen_late() -> None:
    late, prompt = target(delay=0.2), target()
    late.step(n=5)
    assert np.array_equal(late.outputs.x, np.eye(4)[:3]), "what it saw at the start"
    late.step(n=20)
    prompt.step(n=20)
    assert late.outputs.x == pytest.approx(prompt.outputs.x)
    assert late.outputs.v == pytest.approx(prompt.outputs.v)


def test_angles_are_roll_pitch_yaw() -> None:
    bench = target(time=(0.0,), position=(0.0,) * 3, angles=(0.3, -0.4, 0.5))
    turned = (
        rotation(np.array([0, 0, 0.5]))
        @ rotation(np.array([0, -0.4, 0]))
        @ rotation(np.array([0.3, 0, 0]))
    )
    assert bench.outputs.x[:, :3] == pytest.approx(turned)


def test_a_closed_path_repeats() -> None:
    bench = target(
        time=(0.0, 1.0, 2.0), position=(0, 0, 0, 1, 0, 0, 0, 0, 0),
        angles=(0.0,) * 9, repeat=True,
    )  # fmt: skip
    bench.step(n=25)
    assert bench.outputs.x[0, 3] == pytest.approx(1.0)
    bench.step(n=50)
    assert bench.outputs.x[0, 3] == pytest.approx(1.0)


def test_a_target_that_is_not_seen_any_more_moves_no_hand() -> None:
    bench = target()
    bench.step(n=25)
    place = bench.outputs.x.copy()
    bench.off()
    assert np.array_equal(bench.outputs.v, np.zeros(6))
    assert np.array_equal(bench.outputs.x, place)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"time": (0.0, 0.0)}, "times of a path begin at 0 and grow"),
        ({"time": (1.0, 2.0)}, "times of a path begin at 0 and grow"),
        ({"position": (1.0,)}, "position has the wrong number of values"),
        ({"angles": (1.0,) * 7}, "angles has the wrong number of values"),
        ({"repeat": True}, "its end differs from its start"),
    ],
)
def test_what_is_no_path_is_refused(params: dict[str, object], message: str) -> None:
    with pytest.raises(MethodError) as caught:
        target(**params)
    assert message in str(caught.value)


def test_the_example_s_target_and_the_library_s_are_reached() -> None:
    """Every pose of both paths is within the PUMA's reach."""
    for file in (EXAMPLE / "target.rmod", Library().find_rmod("visual_target")):
        bench = Bench(VisualTarget, params=configured(file), freq=25)
        bench.on()
        controller = inverse()
        for _ in range(225):
            bench.step()
            controller.inputs.x = bench.outputs.x
            controller.step(0.04)
        texts = [notice.text for notice in controller.notices()]
        assert not [text for text in texts if "singularity" not in text]
