"""Robot interfaces of simulated robots whose base moves, on a bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import MujocoRobot, RobotModel, rotation
from pbonet.io._mujoco_memory import JointMemory
from pbonet.modules.kinematics.diff_drive import DiffDrive
from pbonet.modules.robot_interfaces.mujoco_base import MujocoBase
from pbonet.modules.robot_interfaces.mujoco_quad import MujocoQuad
from pbonet.modules.sensors.contact import Contact
from pbonet.testing import Bench

mujoco = pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")

QUADRUPED = Path(__file__).parents[3] / "examples" / "quadruped"
CART = Path(__file__).parents[3] / "benchmarks"
BEND = float(np.arccos(0.75))
STAND = np.array([0.0, BEND, -2.0 * BEND] * 4)
BODY = np.column_stack((np.eye(3), [0.0, 0.0, 0.32]))
HIGH = np.column_stack((np.eye(3), [0.0, 0.0, 3.0]))
AT = np.column_stack((np.eye(3), [0.0, 0.0, 0.1]))
HELD = np.array([0.0, 0.8727, 3.2642, 0.0, 0.4762, 4.0572] * 2)
"""Torques with which it stands, from quadruped.svar."""


def quad(**values: Any) -> Bench[MujocoQuad]:
    params = {"model": "quadruped.xml", **values.pop("params", {})}
    told = {"x": BODY, "q": STAND, "tau": HELD, "t_ref": HELD, **values}
    bench = Bench(
        MujocoQuad, params=params, library=[QUADRUPED], freq=500, critical=True, **told
    )
    bench.on()
    return bench


def test_it_stands_where_the_table_says_that_it_was_seen() -> None:
    pose = np.column_stack((rotation(np.array([0.3, -0.2, 1.0])), [1.0, 2.0, 3.0]))
    v, qd = [0.1, 0.2, 0.3, -0.4, 0.5, 0.6], np.linspace(-1.0, 1.0, 12)
    bench = quad(x=pose, v=v, qd=qd)
    assert bench.outputs.ndof == 12
    assert bench.outputs.x == pytest.approx(pose, abs=1e-9)
    assert bench.outputs.v == pytest.approx(v, abs=1e-9)
    assert bench.outputs.q == pytest.approx(STAND, abs=1e-9)
    assert bench.outputs.qd == pytest.approx(qd, abs=1e-9)
    robot = bench.module._robot
    seen = np.zeros(6)
    mujoco.mj_objectVelocity(
        robot._model, robot._data, mujoco.mjtObj.mjOBJ_XBODY, 1, seen, 0
    )
    assert bench.outputs.v == pytest.approx([*seen[3:], *seen[:3]], abs=1e-9)


def test_without_a_pose_in_the_table_it_stands_where_the_file_puts_it() -> None:
    assert quad(x=np.zeros((3, 4))).outputs.x == pytest.approx(BODY, abs=1e-12)


def test_a_torque_moves_the_legs_as_mujoco_s_own_loop_does() -> None:
    bench = quad()
    model = mujoco.MjModel.from_xml_path(str(QUADRUPED / "quadruped.xml"))
    model.opt.timestep = 0.001
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[7:] = [0.0, 0.0, 0.32], STAND
    data.qfrc_applied[6:] = HELD
    rng = np.random.default_rng(2)
    for _ in range(100):
        mujoco.mj_step(model, data, 2)
        torque = HELD + rng.normal(size=12)
        before = data.qfrc_applied[6:].copy()
        data.qfrc_applied[6:] = torque
        bench.inputs.t_ref = torque
        bench.step()
        assert bench.outputs.q == pytest.approx(data.qpos[7:], abs=1e-9)
        assert bench.outputs.qd == pytest.approx(data.qvel[6:], abs=1e-9)
        assert bench.outputs.x[:, 3] == pytest.approx(data.qpos[:3], abs=1e-9)
        assert bench.outputs.tau == pytest.approx(before, abs=1e-12)


LEGS = """<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/>
<geom size="0.1"/>
<body name="b"><joint name="right1"/><geom size="0.1"/>
  <body><joint name="right2"/><geom size="0.1" mass="3"/></body></body>
<body name="a"><joint name="left1" actuatorfrcrange="-2 2" actuatorfrclimited="true"/>
<geom size="0.1"/></body>
</body></worldbody></mujoco>"""


def test_joints_are_in_the_order_that_pinocchio_has(tmp_path: Path) -> None:
    """Which sorts branches by name, where MuJoCo takes them as they are written."""
    (tmp_path / "legs.xml").write_text(LEGS)
    robot = MujocoRobot("legs.xml", [tmp_path], floats=True)
    assert robot.joints == ("left1", "right1", "right2")
    q, qd = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    robot.place(q, qd)
    robot.command(np.array([5.0, 6.0, 7.0]))
    for index, name in enumerate(robot.joints):
        data, model = robot._data, robot._model
        joint = model.joint(name)
        assert data.joint(name).qpos[0] == q[index]
        assert data.joint(name).qvel[0] == qd[index]
        applied = data.qfrc_applied[joint.dofadr[0]]
        assert applied == (2.0 if name == "left1" else 5.0 + index)
    robot.advance(0.001)
    assert robot.q == pytest.approx(q + 0.001 * qd, abs=1e-3)
    wish = np.array([4.0, -3.0, 2.0])
    torque = robot.torque_for(wish)
    for bound, free in zip(robot._bounds, (-np.inf, np.inf), strict=True):
        bound[:] = free
    robot.command(torque)
    robot._data.qfrc_applied[:6] = 0.0
    full = np.zeros(9)
    mujoco.mj_mulM(robot._model, robot._data, full, np.array([0.0] * 6 + [-3, 2, 4]))
    full += robot._data.qfrc_bias - robot._data.qfrc_passive
    assert robot._data.qfrc_applied[6:] == pytest.approx(full[6:], abs=1e-9)


MOUNTED = """<mujoco><worldbody><body name="base">
<body name="z_mount"><body><joint name="legA"/><geom size="0.1"/></body></body>
<body name="a_mount"><body><joint name="legB"/><geom size="0.1"/></body></body>
</body></worldbody></mujoco>"""
LINK = (
    '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
    'ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/>'
    '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)


def test_bodies_named_as_fixed_joints_give_branches_pinocchio_s_order(
    tmp_path: Path,
) -> None:
    pytest.importorskip("pinocchio", reason="pip install 'pbonet[robot]'")
    joints = (
        ("z_mount", "fixed", "base", "za"),
        ("legA", "revolute", "za", "a"),
        ("a_mount", "fixed", "base", "yb"),
        ("legB", "revolute", "yb", "b"),
    )
    parts = [LINK.format(name) for name in ("base", "za", "a", "yb", "b")]
    parts += [JOINT.format(*joint) for joint in joints]
    urdf = f'<robot name="two">{"".join(parts)}</robot>'
    (tmp_path / "two.urdf").write_text(urdf)
    (tmp_path / "two.xml").write_text(MOUNTED)
    robot = MujocoRobot("two.xml", [tmp_path])
    assert robot.joints == RobotModel("two.urdf", [tmp_path]).joints == ("legB", "legA")


def test_memory_of_other_sizes_is_not_that_of_the_joints(tmp_path: Path) -> None:
    (tmp_path / "legs.xml").write_text(LEGS)
    robot = MujocoRobot("legs.xml", [tmp_path], floats=True)
    three, two, bounds = np.zeros(3), np.zeros(2), (np.zeros(3), np.zeros(3))
    for order, q in (((0, 1, 2), two), ((0, 1, 1), three), ((0, 1), three)):
        with pytest.raises(ValueError, match="each once"):
            JointMemory(robot._data, np.array(order), bounds, q, three, three)
    with pytest.raises(ValueError, match="for each joint"):
        robot.command(two)
    with pytest.raises(ValueError, match="a pose is"):
        robot.sense_base(np.zeros((3, 3)), np.zeros(6))


def test_a_push_changes_the_momentum_by_its_force_times_its_time() -> None:
    bench = quad(x=HIGH, t_ref=np.zeros(12), tau=np.zeros(12))
    robot = bench.module._robot
    mass = float(robot._model.body_subtreemass[1])

    def momentum() -> float:
        mujoco.mj_subtreeVel(robot._model, robot._data)
        return mass * float(robot._data.subtree_linvel[1][1])

    bench.step(n=20)
    assert momentum() == pytest.approx(0.0, abs=1e-6)
    bench.set("push", "0 20 0")
    bench.step(n=50)
    assert momentum() == pytest.approx(2.0, rel=1e-3)
    bench.step(n=100)
    assert momentum() == pytest.approx(4.0, rel=1e-3), "it lasts 0.2 s"


@pytest.mark.parametrize("how", ["off", "handover", "error"])
def test_a_push_is_not_repeated_when_it_is_turned_on_again(how: str) -> None:
    bench = quad(x=HIGH, t_ref=np.zeros(12), tau=np.zeros(12))
    bench.set("push", "0 20 0")
    bench.step(n=10)
    if how == "error":
        bench.inputs.t_ref = np.full(12, np.nan)
        with pytest.raises(MethodError):
            bench.step()
        bench.inputs.t_ref = np.zeros(12)
        bench.clear()
    else:
        bench.off(handover=how == "handover")
    bench.on()
    speed = bench.outputs.v[1]
    bench.step(n=20)
    assert bench.outputs.v[1] == pytest.approx(speed, abs=0.01)
    bench.set("push", "0 20 0")
    bench.step(n=20)
    assert bench.outputs.v[1] > speed + 0.03, "a new one pushes"


def test_without_a_fresh_torque_it_stays_in_its_posture() -> None:
    bench = quad()
    bench.step(n=10)
    bench.ages["t_ref"] = 0.06
    largest, before = 0.0, bench.module._robot.torque.copy()
    for _ in range(500):
        bench.step()
        now = bench.module._robot.torque.copy()
        largest = max(largest, float(np.abs(now - before).max()))
        before = now
    assert largest < 0.5, "the torque does not jump"
    assert bench.outputs.q == pytest.approx(STAND, abs=0.02)
    assert bench.outputs.x == pytest.approx(BODY, abs=0.005)
    assert np.abs(bench.outputs.qd).max() < 1e-2
    assert bench.output_age == 0.0, "what is measured is new, whatever was commanded"
    bench.ages["t_ref"] = 0.0
    bench.step(n=10)
    assert bench.module._robot.torque == pytest.approx(HELD)


def test_moving_joints_slow_down_and_stay() -> None:
    qd = np.zeros(12)
    qd[1], qd[8] = 2.0, -1.5
    stiff = {"hold": (400.0,), "damp": (2.0,), "slow": (20.0,)}
    bench = quad(x=HIGH, qd=qd, tau=np.zeros(12), params=stiff)
    bench.illegal = True
    bench.step(n=150)
    moved = bench.outputs.q - STAND
    expected = np.sign(qd) * qd**2 / 40.0
    assert moved == pytest.approx(expected, abs=0.03), "v^2 / 2a, in free fall"
    stopped = bench.outputs.q.copy()
    bench.step(n=100)
    assert bench.outputs.q == pytest.approx(stopped, abs=2e-3)


def test_forces_at_the_feet_are_those_of_the_simulation() -> None:
    """The observer of `contact`, from torques, beside MuJoCo's own contacts."""
    bench = quad()
    feet = ("lf_foot", "lh_foot", "rf_foot", "rh_foot")
    seen = Bench(
        Contact,
        params={"urdf": "quadruped.urdf", "feet": feet},
        library=[QUADRUPED],
        freq=500,
        ndof=12,
        nfeet=4,
        x=BODY,
        q=STAND,
    )
    seen.on()
    bench.ages["t_ref"] = 0.06
    for _ in range(300):
        bench.step()
        for attr in ("x", "v", "q", "qd", "tau"):
            setattr(seen.inputs, attr, getattr(bench.outputs, attr))
        seen.step()
    robot, wrench = bench.module._robot, np.zeros(6)
    assert robot._data.ncon == 4
    for k in range(4):
        contact = robot._data.contact[k]
        foot = feet.index(robot._model.geom(int(max(contact.geom))).name)
        mujoco.mj_contactForce(robot._model, robot._data, k, wrench)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]
        assert seen.outputs.force[foot] == pytest.approx(force, abs=0.5)
    assert seen.outputs.force[:, 2].sum() == pytest.approx(11.8 * 9.81, rel=5e-3)
    assert seen.outputs.contact.tolist() == [1.0] * 4


def test_off_stops_its_time_and_a_handover_does_not_stop_it() -> None:
    bench = quad(qd=[0.5] * 12, x=HIGH)
    bench.step(n=5)
    bench.off(handover=True)
    assert np.abs(bench.outputs.qd).max() > 0.1
    bench.on()
    bench.step()
    where = bench.outputs.x.copy()
    bench.off()
    assert bench.outputs.qd == pytest.approx(np.zeros(12))
    assert bench.outputs.v == pytest.approx(np.zeros(6))
    bench.on()
    assert bench.outputs.x == pytest.approx(where, abs=1e-9)


def test_a_torque_of_a_leg_that_is_no_number_is_an_error_with_its_joint() -> None:
    bench = quad()
    bench.step()
    before = bench.outputs.q.copy()
    bad = HELD.copy()
    bad[5] = np.nan
    bench.inputs.t_ref = bad
    with pytest.raises(MethodError, match="T_REF of joint lh_knee is not finite"):
        bench.step()
    assert bench.state is State.ERROR
    assert bench.outputs.q == pytest.approx(before)


def test_a_base_that_flies_apart_is_named() -> None:
    bench = quad(x=HIGH, v=[2e4, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(MethodError, match="flies apart at base body"):
        bench.step()


ONE = (
    "<mujoco><worldbody><body name='trunk'>{}<geom size='0.1'/>{}</body>"
    "</worldbody></mujoco>"
)
LEG = "<body><joint name='hip' type='{}'/><geom size='0.1'/></body>"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (ONE.format("", LEG.format("hinge")), "its first joint is not free"),
        (ONE.format("<freejoint/>", LEG.format("ball")), "joint hip is a ball or free"),
        (ONE.format("<freejoint/>", ""), "the model has no joint"),
        (ONE.format("<freejoint/>", LEG.format("hinge")), "got 1: hip"),
        ("<mujoco", "MuJoCo cannot read the model"),
    ],
)
def test_a_model_that_is_no_such_robot_is_refused(
    text: str, word: str, tmp_path: Path
) -> None:
    (tmp_path / "robot.xml").write_text(text)
    params = {"model": "robot.xml"}
    with pytest.raises(MethodError) as caught:
        Bench(MujocoQuad, params=params, library=[tmp_path], ndof=2)
    assert word in str(caught.value)


# ------------------------------------------------------------------------ mujoco_base


@pytest.fixture
def cart() -> Any:
    def make(**values: Any) -> Bench[MujocoBase]:
        params = {"model": "cart.xml", "wheels": ("left", "right"), "gain": (1.5,)}
        params |= values.pop("params", {})
        told = {"w_ref": [0.0, 0.0], **values}
        library = [CART]
        bench = Bench(
            MujocoBase, params=params, library=library, freq=500, critical=True, **told
        )
        bench.on()
        return bench

    return make


@pytest.mark.parametrize(
    ("v", "goal", "heading"),
    [((0.4, 0.0, 0.0), (0.8, 0.0), 0.0), ((0.3, 0.0, 0.5), (0.505, 0.276), 1.0)],
)
def test_a_base_goes_where_diff_drive_takes_it(
    cart: Any, v: tuple[float, ...], goal: tuple[float, float], heading: float
) -> None:
    """With slip and the drives' lag: 2 s of a constant velocity."""
    bench = cart()
    drive = Bench(DiffDrive, params={"radius": 0.1, "track": 0.4}, freq=500, v_des=v)
    drive.on()
    for _ in range(1000):
        drive.inputs.w = bench.outputs.w
        drive.step()
        bench.inputs.w_ref = drive.outputs.w_ref
        bench.step()
    pose = bench.outputs.x
    start = np.array([0.05, 0.0])  # the middle of the wheels' axle in the base
    there = pose[:2, 3] + pose[:2, :2] @ start - start
    assert there == pytest.approx(goal, abs=0.04)
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(heading, abs=0.04)
    assert bench.outputs.gyr[2] == pytest.approx(v[2], abs=0.02)
    assert bench.outputs.w == pytest.approx(bench.inputs.w_ref, abs=0.1)
    odometry = drive.outputs.x[:2, 3]
    assert odometry == pytest.approx(there, abs=0.02)


def test_without_fresh_rates_the_wheels_slow_down_and_stay(cart: Any) -> None:
    bench = cart(w_ref=[4.0, 4.0], params={"slow": (8.0,)})
    bench.step(n=500)
    assert bench.outputs.w == pytest.approx([4.0, 4.0], abs=0.1)
    bench.ages["w_ref"] = 0.2
    rates = []
    for _ in range(400):
        bench.step()
        rates.append(bench.outputs.w.copy())
    assert np.abs(np.diff(rates, axis=0)).max() < 0.2, "no jump"
    assert rates[125] == pytest.approx([2.0, 2.0], abs=0.3), "by SLOW"
    assert rates[-1] == pytest.approx([0.0, 0.0], abs=0.05)
    assert bench.output_age == 0.0


def test_a_base_stands_where_the_table_says_that_it_was_seen(cart: Any) -> None:
    pose = np.column_stack((rotation(np.array([0.0, 0.0, 1.0])), [1.0, 2.0, 0.1]))
    bench = cart(x=pose)
    assert bench.outputs.x == pytest.approx(pose, abs=1e-9)
    bench.inputs.w_ref = [3.0, 3.0]
    bench.step(n=200)
    bench.off()
    where = bench.outputs.x.copy()
    assert bench.outputs.w == pytest.approx([0.0, 0.0])
    bench.on()
    assert bench.outputs.x == pytest.approx(where, abs=1e-9)
    assert cart().outputs.x[:, 3] == pytest.approx([0.0, 0.0, 0.1])


def test_a_base_goes_on_at_a_handover_and_rests_after_off(cart: Any) -> None:
    bench = cart(w_ref=[5.0, 4.0])
    bench.step(n=500)
    bench.off(handover=True)
    names = ("x", "v", "w", "gyr")
    seen = {name: getattr(bench.outputs, name).copy() for name in names}
    assert seen["w"] == pytest.approx([5.0, 4.0], abs=0.2)
    assert np.hypot(*seen["v"][:2]) > 0.3
    successor = cart(w_ref=[5.0, 4.0], **seen)
    for name, value in seen.items():
        assert getattr(successor.outputs, name) == pytest.approx(value, abs=1e-9)
    before = successor.outputs.x.copy()
    for _ in range(50):
        successor.step()
        assert successor.outputs.w == pytest.approx(seen["w"], abs=0.1)
        assert successor.outputs.v[:2] == pytest.approx(seen["v"][:2], abs=0.05)
    moved = np.linalg.norm(successor.outputs.x[:, 3] - before[:, 3])
    assert moved == pytest.approx(0.1 * np.linalg.norm(seen["v"][:3]), rel=0.1)
    successor.off()
    assert not np.concatenate([getattr(successor.outputs, n) for n in names[1:]]).any()
    successor.on()
    assert successor.outputs.w == pytest.approx([0.0, 0.0])


def test_a_successor_whose_rates_are_old_slows_down_from_what_it_took(
    cart: Any,
) -> None:
    bench = cart(w=[4.0, 4.0], v=[0.4, 0, 0, 0, 0, 0], x=AT, params={"slow": (8.0,)})
    bench.illegal = True
    bench.step(n=125)
    assert bench.outputs.w == pytest.approx([2.0, 2.0], abs=0.3)


def test_a_rate_that_is_no_number_is_an_error_with_its_wheel(cart: Any) -> None:
    bench = cart()
    bench.inputs.w_ref = [1.0, np.nan]
    with pytest.raises(MethodError, match="W_REF of wheel right is not finite"):
        bench.step()
    assert bench.state is State.ERROR


def test_a_gain_is_set_for_each_wheel(cart: Any) -> None:
    bench = cart(w_ref=[2.0, 2.0])
    bench.set("gain", "0.25 0.5")
    bench.step()
    left, right = bench.module._torque[bench.module._wheels]
    assert (left, right) == pytest.approx((0.5, 1.0), abs=0.01)
    with pytest.raises(MethodError, match="wheels is read when the task is created"):
        bench.set("wheels", "right left")


@pytest.mark.parametrize(
    ("wheels", "word"),
    [
        (("left", "rigth"), "the base has no joint rigth"),
        (("left", "left"), "WHEELS names joint left twice"),
        (("left",), "got 1: left"),
    ],
)
def test_wheels_that_are_not_there_are_named(
    cart: Any, wheels: tuple[str, ...], word: str
) -> None:
    with pytest.raises(MethodError) as caught:
        cart(params={"wheels": wheels})
    assert word in str(caught.value)
