"""The steps of legged robots, on a bench: feet do not slip, and the body keeps up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from pbonet.errors import MethodError
from pbonet.modules.trajectories.gait import Gait
from pbonet.testing import Bench

DT = 0.004
TROT = np.array([[x, y, -0.3] for x in (0.2, -0.2) for y in (0.15, -0.15)])


def gait(places=TROT, **params) -> Bench[Gait]:
    start = {"feet": params.pop("start")} if "start" in params else {}
    values = {"nfeet": len(places), **start}
    values |= {"critical": True} if params.pop("critical", False) else {}
    bench = Bench(
        Gait, params={"feet": places.ravel(), **params}, freq=1 / DT, **values
    )
    bench.on()
    return bench


def walk(bench: Bench[Gait], v, cycles: int) -> tuple[np.ndarray, np.ndarray]:
    """Return feet, [cycles + 1, n, 3], and contacts of a body with this velocity."""
    bench.inputs.v_des = v
    feet, contact = [bench.outputs.feet.copy()], [bench.outputs.contact.copy()]
    for _ in range(cycles):
        bench.step()
        feet.append(bench.outputs.feet.copy())
        contact.append(bench.outputs.contact.copy())
    return np.array(feet), np.array(contact)


def in_the_world(feet: np.ndarray, v) -> np.ndarray:
    """Return the feet seen from the ground, by the exponential of SE(2)."""
    x, y, w = v
    twist = np.array([[0.0, -w, x], [w, 0.0, y], [0.0, 0.0, 0.0]])
    seen, pose, step = feet.copy(), np.eye(3), expm(twist * DT)
    for k, rows in enumerate(feet):
        seen[k, :, :2] = rows[:, :2] @ pose[:2, :2].T + pose[:2, 2]
        pose = pose @ step
    return seen


SIX = np.array([[x, y, -0.2] for x in (0.3, 0.0, -0.3) for y in (0.2, -0.2)])
TRIPOD = {"phases": (0.0, 0.5, 0.5, 0.0, 0.0, 0.5)}
ONE = {"phases": (0.0,)}


@pytest.mark.parametrize("v", [(0.4, 0, 0), (0.2, -0.1, 0.5), (0.0, 0.0, -0.8)])
@pytest.mark.parametrize(
    ("places", "params"),
    [(TROT, {}), (SIX, TRIPOD), (TROT[:1], ONE), (np.tile(TROT, (7, 1)), ONE)],
    ids=["four legs", "six legs", "one leg", "28 legs"],
)
def test_a_foot_on_the_ground_does_not_slip(places, params, v) -> None:
    feet, contact = walk(gait(places, **params), v, 250)
    seen = in_the_world(feet, v)
    stands = (contact[1:] == 1.0) & (contact[:-1] == 1.0)
    moved = np.abs(np.diff(seen, axis=0)).max(axis=2)
    assert moved[stands].max() < 1e-9
    assert moved[~stands].max() > 1e-4, "others move"
    assert np.abs(feet[contact == 1.0][:, 2] - places[0, 2]).max() < 1e-12


def test_steps_are_as_the_parameters_say() -> None:
    v = (0.4, 0.0, 0.0)
    bench = gait(height=0.07)
    walk(bench, v, 250)
    feet, contact = walk(bench, v, 125)
    assert contact[:125].mean(axis=0) == pytest.approx([0.6] * 4, abs=0.01)
    assert (contact[:, 0] == contact[:, 3]).all(), "diagonal feet step together"
    assert feet[:, :, 2].max() == pytest.approx(-0.3 + 0.07, abs=1e-3)
    way = 0.4 * 0.6 * 0.5
    for foot, (x, y, _) in enumerate(TROT):
        along = feet[:, foot, 0] - x
        assert along.max() == pytest.approx(way / 2, abs=0.4 * DT * 1.1)
        assert along.min() == pytest.approx(-way / 2, abs=0.4 * DT * 1.1)
        assert np.abs(feet[:, foot, 1] - y).max() < 1e-12


def test_a_foot_in_the_air_does_not_jump_when_the_velocity_changes() -> None:
    bench = gait()
    before = bench.outputs.feet.copy()
    for k in range(250):
        bench.inputs.v_des = [0.3 * math.copysign(1.0, math.sin(k / 10.0)), 0.2, 0.0]
        bench.step()
        assert np.abs(bench.outputs.feet - before).max() < 0.02
        before = bench.outputs.feet.copy()


def test_without_a_velocity_the_feet_return_to_their_places_and_stand() -> None:
    bench = gait()
    walk(bench, (0.4, 0.1, 0.3), 90)
    assert np.abs(bench.outputs.feet - TROT).max() > 0.01
    walk(bench, (0.0, 0.0, 0.0), 250)
    feet, contact = walk(bench, (0.0, 0.0, 0.0), 150)
    assert np.abs(feet - TROT).max() < 1e-6
    assert contact.min() == 1.0
    assert np.abs(np.diff(feet, axis=0)).max() == 0.0


def test_the_feet_begin_where_they_are() -> None:
    start = TROT + np.array([0.01, -0.02, 0.0])
    bench = gait(start=start)
    assert np.array_equal(bench.outputs.feet, start), "bumpless"
    bench.step()
    assert np.array_equal(bench.outputs.feet, start)
    walk(bench, (0.0, 0.0, 0.0), 300)
    assert np.abs(bench.outputs.feet - TROT).max() < 1e-6
    assert np.array_equal(gait().outputs.feet, TROT)


@pytest.mark.parametrize("how", ["old", "nan", "illegal"])
def test_without_a_command_they_stop_and_stand(how: str) -> None:
    bench = gait(critical=how == "illegal")
    walk(bench, (0.4, 0.0, 0.0), 80)
    if how == "old":
        bench.ages["v_des"] = 0.6
    bench.illegal = how == "illegal"
    walk(bench, (math.nan if how == "nan" else 0.4, 0.0, 0.0), 300)
    assert np.abs(bench.outputs.feet - TROT).max() < 1e-6
    warned = [one.text for one in bench.notices() if "V_DES" in one.text]
    assert warned == ["V_DES is not finite: the base stops"] * (how == "nan")


def test_a_gait_that_begins_in_the_air_is_refused() -> None:
    with pytest.raises(MethodError, match=r"each of PHASES below STANCE, 0\.6"):
        gait(phases=(0.0, 0.5, 0.5, 0.7))
    with pytest.raises(MethodError, match="expected 12: 4 rows of 3, got 3 values"):
        Bench(Gait, params={"feet": (1.0, 2.0, 3.0)}, nfeet=4)
