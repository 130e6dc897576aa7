"""Modules that know their robot from a URDF file, on a bench."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from urdf_chains import Chain, write_chain

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import difference, rotation
from pbonet.modules.controllers.computed_torque import ComputedTorque
from pbonet.modules.controllers.gravity import Gravity
from pbonet.modules.kinematics.fk_jac import FkJac
from pbonet.modules.kinematics.ik_placo import IkPlaco
from pbonet.testing import Bench

PANDA = Path(__file__).parents[3] / "examples" / "panda"
HOME = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.785])
SIZES = [1, 2, 6, 7, 13, 30]
TORQUE = {"urdf": "robot.urdf", "kp": (100.0,), "kd": (20.0,)}


@pytest.fixture(params=SIZES)
def chain(request: pytest.FixtureRequest, tmp_path: Path) -> Chain:
    return write_chain(tmp_path, request.param, damping=0.3)


def drawn(chain: Chain, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, chain.n)


def bench_of(cls: type, chain: Chain, **values: Any) -> Bench[Any]:
    params = {"urdf": "robot.urdf", **values.pop("params", {})}
    values = {"ndof": chain.n, "library": [chain.path.parent], **values}
    return Bench(cls, params=params, freq=500, **values)


# ---------------------------------------------------------- against other computations


def test_pose_and_jacobian_are_those_of_the_joints_axes(chain: Chain) -> None:
    bench = bench_of(FkJac, chain, params={"frame": "hand"}, q=drawn(chain, 0))
    bench.on()
    for seed in range(3):
        q = drawn(chain, seed)
        bench.inputs.q = q
        bench.step()
        hand = chain.frames(q)[-1]
        jacobian = chain.jacobian(q, hand[:3, 3], chain.n - 1)
        assert bench.outputs.x == pytest.approx(hand[:3], abs=1e-9)
        assert bench.outputs.jacobian == pytest.approx(jacobian, abs=1e-9)
        scaled = jacobian / np.array([[0.2]] * 3 + [[1.0]] * 3)
        sigma = np.linalg.svd(scaled, compute_uv=False)[-1]
        assert bench.outputs.sigma == pytest.approx(sigma, abs=1e-9)


def test_gravity_is_that_of_the_weights(chain: Chain) -> None:
    bench = bench_of(Gravity, chain, q=drawn(chain, 1))
    bench.on()
    held = chain.gravity(drawn(chain, 1))
    assert bench.outputs.t_grav == pytest.approx(held, abs=1e-9)


def test_computed_torque_gives_the_acceleration_that_it_wants(chain: Chain) -> None:
    """Against MuJoCo, which computes the motion that the torque makes."""
    mujoco = pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")
    q, qd, q_ref, qd_ref, qdd_ref = (drawn(chain, seed) for seed in range(5))
    bench = bench_of(
        ComputedTorque,
        chain,
        params={"kp": (100.0,), "kd": (20.0,)},
        q=q,
        qd=qd,
        q_ref=q_ref,
        qd_ref=qd_ref,
        qdd_ref=qdd_ref,
    )
    bench.module._takeover.bound(-np.inf, np.inf)  # the law itself
    bench.on(handover=True)
    bench.step(n=60)  # the takeover is over after 0.1 s
    model = mujoco.MjModel.from_xml_path(str(chain.path))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, qd
    data.qacc[:] = qdd_ref + 20.0 * (qd_ref - qd) + 100.0 * (q_ref - q)
    mujoco.mj_inverse(model, data)
    scale = np.abs(data.qfrc_inverse).max()
    assert bench.outputs.tau == pytest.approx(
        data.qfrc_inverse, rel=1e-9, abs=1e-9 * scale
    )


@pytest.mark.parametrize("size", [2, 7, 13])
def test_a_step_of_placo_is_that_of_the_normal_equations(
    size: int, tmp_path: Path
) -> None:
    pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")
    chain = write_chain(tmp_path, size)
    q = 0.3 * drawn(chain, 3)
    hand = chain.frames(q)[-1]
    goal = hand[:3].copy()
    turn = np.array([0.01, -0.02, 0.015])
    goal[:, 3] += [0.001, -0.002, 0.0015]
    goal[:, :3] = rotation(turn) @ goal[:, :3]
    params = {"frame": "hand", "joint_accel": 1e9}
    bench = bench_of(
        IkPlaco, chain, params=params, x_des=goal, q_ref=q, v_des=[0.01] * 6
    )
    bench.on()
    assert bench.outputs.q_ref == pytest.approx(q, abs=1e-12)
    bench.step()
    wish = 10.0 * difference(goal, hand[:3]) + 0.01
    jacobian = chain.jacobian(q, hand[:3, 3], chain.n - 1)
    weights = np.diag([25.0] * 3 + [1.0] * 3)
    normal = jacobian.T @ weights @ jacobian + 1e-4 * np.eye(chain.n)
    step = np.linalg.solve(normal, jacobian.T @ weights @ wish * 0.002)
    assert bench.outputs.q_ref == pytest.approx(q + step, abs=1e-9)
    assert bench.outputs.qd_ref == pytest.approx(step / 0.002, abs=1e-6)


# ------------------------------------------------------------------- computed_torque


def panda_torque() -> Bench[ComputedTorque]:
    return Bench(
        ComputedTorque,
        params={"urdf": "panda.urdf", "kp": (400.0,), "kd": (40.0,)},
        library=[PANDA],
        freq=500,
        ndof=7,
        q=HOME,
        q_ref=HOME + 0.01,
        tau=[5.0, -40.0, 3.0, 20.0, 1.0, 1.0, 0.5],
    )


def test_torque_goes_on_from_what_was_commanded_and_fades() -> None:
    bench = panda_torque()
    before = bench.outputs.tau.copy()
    bench.on()
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9)
    bench.step()
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9)
    steps = []
    for _ in range(60):
        last = bench.outputs.tau.copy()
        bench.step()
        steps.append(np.abs(bench.outputs.tau - last).max())
    assert max(steps) < 2.0, "a fiftieth of the distance, at most 1.5 times"
    assert steps[-1] < 1e-9, "and then the law has it alone"


def test_torque_stays_within_what_the_file_allows() -> None:
    bench = panda_torque()
    bench.inputs.q_ref = HOME + 3.0
    bench.on(handover=True)
    bench.step(n=60)
    limit = np.array([87.0] * 4 + [12.0] * 3)
    assert np.abs(bench.outputs.tau) == pytest.approx(limit), "all the arm has"


def test_a_joint_that_is_not_measured_is_an_error_and_no_torque() -> None:
    bench = panda_torque()
    bench.on()
    bench.step()
    before = bench.outputs.tau.copy()
    bench.inputs.q = [0.0, np.nan, 0.0, -2.2, 0.0, 1.8, 0.785]
    with pytest.raises(MethodError, match="T_REF"):
        bench.step()
    assert bench.state is State.ERROR
    assert bench.outputs.tau == pytest.approx(before), "nothing was written"
    bench.inputs.q = HOME
    bench.clear()
    bench.on()
    bench.step()
    assert bench.outputs.tau == pytest.approx(before, abs=1e-9), "and it goes on"


def test_gains_are_set_while_it_is_on_and_the_robot_is_not() -> None:
    bench = panda_torque()
    bench.on()
    bench.step(n=60)
    soft = bench.outputs.tau.copy()
    bench.set("kp", "800")
    bench.step()
    assert np.abs(bench.outputs.tau - soft).max() > 1.0
    with pytest.raises(MethodError, match="urdf is read when the task is created"):
        bench.set("urdf", "other.urdf")


# -------------------------------------------------------------------------- ik_placo


def panda_pose(q: np.ndarray = HOME) -> np.ndarray:
    params = {"urdf": "panda.urdf", "frame": "hand"}
    bench = Bench(FkJac, params=params, library=[PANDA], ndof=7, q=q)
    bench.on()
    return bench.outputs.x.copy()


def pursuit(**values: Any) -> Bench[IkPlaco]:
    pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")
    bench = Bench(
        IkPlaco,
        params={"urdf": "panda.urdf", "frame": "hand", **values.pop("params", {})},
        library=[PANDA],
        **{"freq": 500, "ndof": 7, "q_ref": HOME, "x_des": panda_pose(), **values},
    )
    bench.on()
    return bench


def largest_step(bench: Bench[IkPlaco], cycles: int) -> float:
    largest = 0.0
    for _ in range(cycles):
        before = bench.outputs.q_ref.copy()
        bench.step()
        largest = max(largest, float(np.abs(bench.outputs.q_ref - before).max()))
    return largest


def test_the_hand_arrives_and_no_joint_jumps() -> None:
    bench = pursuit()
    goal = panda_pose(HOME + 0.2)
    bench.inputs.x_des = goal
    assert largest_step(bench, 1500) < 0.004
    assert panda_pose(bench.outputs.q_ref) == pytest.approx(goal, abs=1e-6)
    assert bench.notices() == []


def test_a_goal_out_of_reach_is_approached_and_told_once() -> None:
    bench = pursuit()
    goal = panda_pose()
    goal[0, 3] = 3.0
    bench.inputs.x_des = goal
    assert largest_step(bench, 3000) < 0.006
    (notice,) = bench.notices()
    assert "frame hand cannot follow X_DES" in notice.text
    reached = panda_pose(bench.outputs.q_ref)[:, 3]
    assert np.linalg.norm(reached - [0.0, 0.0, 0.333]) > 0.75, "it is stretched"
    bench.inputs.x_des = panda_pose()
    assert largest_step(bench, 3000) < 0.006, "and comes back"
    assert panda_pose(bench.outputs.q_ref) == pytest.approx(panda_pose(), abs=1e-3)


@pytest.mark.parametrize("freq", [1.0, 2.0, 10.0])
def test_the_hand_arrives_at_a_low_frequency(freq: float) -> None:
    bench = pursuit(freq=freq)
    goal = panda_pose(HOME + 0.2)
    bench.inputs.x_des = goal
    bench.step(n=40)
    assert panda_pose(bench.outputs.q_ref) == pytest.approx(goal, abs=1e-6)


def velocities(bench: Bench[IkPlaco], cycles: int) -> np.ndarray:
    """Return Q^_REF before and after each of the cycles."""
    found = [bench.outputs.qd_ref.copy()]
    for _ in range(cycles):
        bench.step()
        found.append(bench.outputs.qd_ref.copy())
    return np.array(found)


FAR = {
    "out of reach": lambda goal: goal + np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 5.0]),
    "a turn that a wrist cannot do": lambda goal: np.column_stack((
        goal[:, :3] @ rotation(np.array([0.0, 0.0, 2.5])),
        goal[:, 3],
    )),
    "out of reach at the other side": lambda goal: goal * [[1.0] * 3 + [-9.0]],
}


@pytest.mark.parametrize("goal", FAR)
def test_a_goal_that_jumps_is_approached_by_the_joints_acceleration(goal: str) -> None:
    bench = pursuit()
    bench.inputs.x_des = FAR[goal](panda_pose())
    there = velocities(bench, 4000)
    bench.inputs.x_des = panda_pose()
    back = velocities(bench, 4000)
    for found in (there, back):
        most = np.abs(np.diff(found, axis=0)).max()
        assert most == pytest.approx(20.0 * 0.002, rel=1e-6), "all it has, and no more"
        assert np.abs(found[-1]).max() < 0.02, "and the joints come to rest"


def test_a_goal_is_approached_from_the_velocity_that_was_there() -> None:
    bench = pursuit(qd_ref=[0.0, 0.5, 0.0, -0.4, 0.0, 0.3, 0.0])
    assert np.abs(np.diff(velocities(bench, 50), axis=0)).max() <= 0.0400001


def test_more_than_the_largest_speed_is_braked_as_fast_as_it_may() -> None:
    bench = pursuit(qd_ref=[0.0] * 6 + [9.0])
    found = velocities(bench, 300)[:, 6]
    assert np.abs(np.diff(found)).max() <= 0.0400001
    assert found[-1] < 2.62
    assert bench.notices() == []


def test_a_joint_at_its_limit_is_named_and_keeps_it() -> None:
    bench = pursuit()
    goal = panda_pose()
    goal[:, :3] = goal[:, :3] @ rotation(np.array([0.0, 0.0, 2.5]))
    bench.inputs.x_des = goal
    assert largest_step(bench, 2500) < 0.006
    texts = " ".join(notice.text for notice in bench.notices())
    assert "joint7 is at its limit, 2.8973 rad of -2.8973 to 2.8973" in texts
    assert bench.outputs.q_ref[6] <= 2.8973 + 1e-6


def test_past_a_singularity_no_joint_exceeds_its_speed() -> None:
    """The arm is stretched out: its elbow has no direction in which it helps."""
    q = np.array([0.0, 0.3, 0.0, -0.0698, 0.0, 1.0, 0.0])
    bench = pursuit(q_ref=q, x_des=panda_pose(q))
    goal = panda_pose(q)
    goal[:, 3] *= 0.7
    bench.inputs.x_des = goal
    assert largest_step(bench, 3000) <= 2.61 * 0.002 + 1e-9


def test_limits_that_cannot_be_kept_leave_the_reference() -> None:
    bad = HOME.copy()
    bad[3] = 0.5  # its largest is -0.0698: more than a step away
    bench = pursuit(q_ref=bad)
    bench.step(n=3)
    assert bench.outputs.q_ref == pytest.approx(bad, abs=1e-12)
    assert bench.outputs.qd_ref == pytest.approx(np.zeros(7))
    (notice,) = bench.notices()
    assert "joint4 is at its limit, 0.5000 rad" in notice.text
    assert "Q_REF does not change" in notice.text


@pytest.mark.parametrize(
    ("port", "index", "word"),
    [("x_des", (0, 3), "not finite"), ("x_des", (1, 1), "not finite"),
     ("v_des", (4,), "X\\^_DES of frame hand is not finite")],
)  # fmt: skip
def test_a_goal_that_is_no_number_leaves_the_reference(
    port: str, index: tuple[int, ...], word: str
) -> None:
    bench = pursuit()
    value = np.array(getattr(bench.inputs, port))
    value[index] = np.nan
    setattr(bench.inputs, port, value)
    bench.step(n=3)
    assert bench.outputs.q_ref == pytest.approx(HOME, abs=1e-12)
    (notice,) = bench.notices()
    assert pytest.approx(HOME) == bench.outputs.q_ref
    assert word.replace("\\", "") in notice.text
    setattr(bench.inputs, port, np.zeros(6) if port == "v_des" else panda_pose())
    bench.step()
    assert bench.state is State.ON


# ------------------------------------------------------------------------ wrong robots


def said(cls: type, chain: Chain, **params: Any) -> str:
    with pytest.raises(MethodError) as caught:
        bench_of(cls, chain, params=params)
    return str(caught.value)


@pytest.mark.parametrize("cls", [FkJac, IkPlaco])
def test_a_frame_that_is_not_there_is_named(cls: type, tmp_path: Path) -> None:
    text = said(cls, write_chain(tmp_path, 3), frame="hnad")
    assert "the robot has no frame hnad" in text
    assert "did you mean hand" in text


def test_a_file_that_is_not_there_is_named_with_the_folders(tmp_path: Path) -> None:
    text = said(Gravity, write_chain(tmp_path, 2), urdf="panda.urdf")
    assert 'there is no file "panda.urdf"' in text
    assert str(tmp_path) in text


def test_an_absolute_path_is_taken_as_it_is(tmp_path: Path) -> None:
    chain = write_chain(tmp_path, 2)
    bench_of(Gravity, chain, params={"urdf": str(chain.path)}, library=[]).on()


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("no xml", "no URDF model"),
        ('<robot name="r"><link name="base"/></robot>', "no joint"),
        (
            '<robot name="r"><link name="base"/><link name="wheel"/><joint name="hub" '
            'type="continuous"><parent link="base"/><child link="wheel"/></joint>'
            "</robot>",
            "joint hub turns without limits",
        ),
    ],
)
def test_a_file_that_is_no_such_robot_is_refused(
    text: str, word: str, tmp_path: Path
) -> None:
    chain = write_chain(tmp_path, 2)
    chain.path.write_text(text)
    assert word in said(Gravity, chain)


def test_another_number_of_joints_is_refused_with_their_names(tmp_path: Path) -> None:
    chain = write_chain(tmp_path, 3)
    with pytest.raises(MethodError, match="got 3: joint1 joint2 joint3"):
        bench_of(Gravity, chain, ndof=2)


def test_a_package_that_is_not_there_is_named_with_its_extra() -> None:
    code = (
        "import sys; sys.modules['pinocchio'] = None\n"
        "from pbonet.io import RobotModel\n"
        f"RobotModel({str(PANDA / 'panda.urdf')!r})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert "pip install 'pbonet[robot]'" in done.stderr
