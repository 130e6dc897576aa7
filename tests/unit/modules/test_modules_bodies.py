"""Where a robot's mass is, and how near its links are: com_zmp and self_collision."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from urdf_chains import write_balls

from pbonet import State
from pbonet.errors import MethodError, ParameterError
from pbonet.io import MujocoRobot, rotation
from pbonet.modules.kinematics.com_zmp import ComZmp
from pbonet.modules.kinematics.self_collision import SelfCollision
from pbonet.testing import Bench

pytest.importorskip("pinocchio", reason="pip install 'pbonet[robot]'")

QUADRUPED = Path(__file__).parents[3] / "examples" / "quadruped"
BEND = float(np.arccos(0.75))
STAND = np.array([0.0, BEND, -2.0 * BEND] * 4)
BODY = np.column_stack((np.eye(3), [0.3, -0.2, 0.32]))
DT = 0.002


# ---------------------------------------------------------------------------- com_zmp


def legs(**params: Any) -> Bench[ComZmp]:
    given = {"urdf": "quadruped.urdf", **params}
    start = {"ndof": 12, "x": BODY, "q": STAND}
    bench = Bench(ComZmp, params=given, library=[QUADRUPED], freq=1 / DT, **start)
    bench.on()
    return bench


def moves(bench: Bench[ComZmp], x: Any, v: Any, q: Any, qd: Any) -> None:
    bench.inputs.x, bench.inputs.v, bench.inputs.q, bench.inputs.qd = x, v, q, qd
    bench.step(DT)


class Momenta:
    """Centre of mass and momenta by MuJoCo, of the same robot as an MJCF file."""

    def __init__(self) -> None:
        self.mujoco = pytest.importorskip("mujoco", reason="pbonet[mujoco]")
        self.robot = MujocoRobot("quadruped.xml", [QUADRUPED], floats=True)

    def of(self, x: Any, v: Any, q: Any, qd: Any) -> tuple[np.ndarray, ...]:
        """Return centre, its velocity, and the momentum about it."""
        self.robot.place(q, qd)
        self.robot.place_base(x, v)
        model, data = self.robot._model, self.robot._data
        self.mujoco.mj_subtreeVel(model, data)
        return tuple(
            one[1].copy()
            for one in (data.subtree_com, data.subtree_linvel, data.subtree_angmom)
        )


def test_centre_of_mass_and_zero_moment_point_are_those_of_mujoco_s_momenta() -> None:
    rng, by, bench = np.random.default_rng(3), Momenta(), legs(smooth=0.0, height=0.1)
    was = None
    for _ in range(20):
        x = np.column_stack((rotation(rng.normal(size=3)), rng.normal(size=3)))
        q, v, qd = STAND + 0.1 * rng.normal(size=12), rng.normal(size=6), np.zeros(12)
        v, qd = 1e-3 * v, 1e-3 * rng.normal(size=12)
        moves(bench, x, v, q, qd)
        com, com_dot, k = by.of(x, v, q, qd)
        assert bench.outputs.com == pytest.approx(com, abs=1e-9)
        assert bench.outputs.com_dot == pytest.approx(com_dot, abs=1e-9)
        force, turn = np.array([0.0, 0.0, 11.8 * 9.81]), np.zeros(3)
        if was is not None:
            force += 11.8 * (com_dot - was[0]) / DT
            turn = (k - was[1]) / DT
        was = com_dot, k
        point = np.array([*bench.outputs.zmp, 0.1])
        moment = np.cross(com - point, force) + turn
        assert moment[:2] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_an_acceleration_moves_the_point_and_rest_has_it_below_the_mass() -> None:
    bench = legs()
    bench.step(DT)
    com = bench.outputs.com.copy()
    assert bench.outputs.zmp == pytest.approx(com[:2], abs=1e-12)
    for k in range(1, 201):
        moves(bench, BODY, [0.5 * k * DT, 0, 0, 0, 0, 0], STAND, np.zeros(12))
    wanted = [com[0] - com[2] * 0.5 / 9.81, com[1]]
    assert bench.outputs.zmp == pytest.approx(wanted, abs=1e-6), "smoothed"


def test_in_flight_the_point_stays() -> None:
    bench = legs()
    bench.step(DT)
    before = bench.outputs.zmp.copy()
    for k in range(1, 201):
        v = [0.1 * k * DT, 0, -9.81 * k * DT, 0, 0, 0]
        moves(bench, BODY, v, STAND, np.zeros(12))
    assert np.abs(bench.outputs.zmp - before).max() < 0.05
    last = bench.outputs.zmp.copy()
    moves(bench, BODY, [5.0, 0, -9.81 * 0.4, 0, 0, 0], STAND, np.zeros(12))
    assert np.array_equal(bench.outputs.zmp, last)


def test_a_measurement_that_is_no_number_is_an_error_of_com_zmp() -> None:
    bench = legs()
    bench.inputs.q = [math.nan] + [0.0] * 11
    with pytest.raises(MethodError, match="Q_MEZ of joint lf_roll is not finite"):
        bench.step(DT)
    assert bench.state is State.ERROR


# --------------------------------------------------------------------- self_collision

BOX = '<collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision>'


def collider(folder: Path, q: Any = (0.0,) * 3, **params: Any) -> Bench[SelfCollision]:
    given = {"urdf": "robot.urdf", **params}
    bench = Bench(
        SelfCollision, params=given, library=[folder], ndof=len(q), q=q, freq=100
    )
    bench.on()
    return bench


def places(q: np.ndarray) -> np.ndarray:
    """Return where the links begin."""
    found = [np.zeros(2), np.array([1.0, 0.0])]
    for angle in np.cumsum(q)[:-1]:
        found.append(found[-1] + [math.cos(angle), math.sin(angle)])
    return np.array(found)


@pytest.mark.parametrize("n", [2, 3, 8])
def test_distance_is_that_of_the_balls(n: int, tmp_path: Path) -> None:
    write_balls(tmp_path, n)
    rng = np.random.default_rng(n)
    bench = collider(tmp_path, (0.0,) * n, near=0.0)
    for _ in range(50):
        q = rng.uniform(-2.5, 2.5, n)
        bench.inputs.q = q
        bench.step()
        at = places(q)
        wanted = min(
            float(np.linalg.norm(at[i] - at[k])) - 0.2
            for i in range(n + 1)
            for k in range(i + 2, n + 1)
        )
        assert bench.outputs.dist == pytest.approx(wanted, abs=1e-9)


def test_distance_to_a_box_is_that_of_its_face(tmp_path: Path) -> None:
    write_balls(tmp_path, 3, BOX)
    bench = collider(tmp_path, [math.pi / 2, math.pi / 2, math.pi / 2])
    assert bench.outputs.dist == pytest.approx(1.0 - 0.2, abs=1e-6)


def test_links_that_come_near_are_named_once(tmp_path: Path) -> None:
    write_balls(tmp_path, 3)
    bench = collider(tmp_path, near=0.5)
    for angle in (2.0, 2.3, 2.35, 2.25, 2.3, 1.0, 2.3):
        bench.inputs.q = [angle, angle, 0.0]
        bench.step()
    texts = [one.text for one in bench.notices()]
    assert len(texts) == 2
    assert texts[0].startswith("base and l3 are "), texts


def test_pairs_that_may_touch_are_left_out(tmp_path: Path) -> None:
    write_balls(tmp_path, 3)
    q = [2.0, 2.5, 0.0]
    both = collider(tmp_path, q).outputs.dist
    less = collider(tmp_path, q, ignore=("l3:base",)).outputs.dist
    assert both < less


@pytest.mark.parametrize(
    ("params", "told"),
    [
        ({"ignore": ("base",)}, "IGNORE names no pair of links"),
        ({"ignore": ("base:l4",)}, "the robot has no link l4 with a shape"),
        ({"ignore": ("base:l2", "base:l3", "l1:l3")}, "no two links that could meet"),
    ],
)
def test_what_cannot_be_compared_is_refused(params, told, tmp_path: Path) -> None:
    write_balls(tmp_path, 3)
    with pytest.raises((MethodError, ParameterError), match=told):
        collider(tmp_path, **params)


def test_a_shape_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    mesh = '<mesh filename="package://none/missing.stl"/>'
    write_balls(tmp_path, 3, f"<collision><geometry>{mesh}</geometry></collision>")
    with pytest.raises((MethodError, ParameterError), match=r"missing\.stl"):
        collider(tmp_path)


def test_a_measurement_that_is_no_number_is_an_error(tmp_path: Path) -> None:
    write_balls(tmp_path, 3)
    bench = collider(tmp_path)
    bench.inputs.q = [0.0, math.nan, 0.0]
    with pytest.raises(MethodError, match="Q_MEZ of joint j2 is not finite"):
        bench.step()
    assert bench.state is State.ERROR
