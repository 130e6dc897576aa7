"""Visual servoing after a ball: camera, feature and module, and what stops them."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from drawn_pictures import EXAMPLE, drawn_camera

from pbonet.config import read_rmod
from pbonet.config.library import Library
from pbonet.errors import MethodError, ParameterError
from pbonet.io import PUMA560, Blob, MujocoCamera, Pinhole, red_blob
from pbonet.modules._dh import Geometry
from pbonet.modules._tracked_point import TrackedPoint
from pbonet.modules.trajectories import visual_ball
from pbonet.modules.trajectories.visual_ball import VisualBall
from pbonet.pbo import decode_params
from pbonet.testing import Bench

SIZE = WIDTH, HEIGHT = 320, 240
FOVY = np.radians(60.0)
RADIUS, DISTANCE = 0.04, 0.4
EYE = np.array([0.0, 0.0, 0.06])
TURN = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
HAND = np.column_stack((TURN, [0.55, -0.1, -0.1]))
"""It looks along x, and the picture's right is -y."""
AHEAD = np.array([0.95, -0.1, -0.1])
BALL = np.column_stack((TURN, AHEAD))
POSTURE = np.array([0.091896, 0.701320, -3.292329, 0.107718, 1.022801, -1.627074])
CAMERA = Pinhole(WIDTH, HEIGHT, FOVY)

# -------------------------------------------------------------------------- geometry

PLACES = list(product((-0.15, 0.0, 0.2), (-0.1, 0.05), (0.25, 1.5)))


@pytest.mark.parametrize("place", PLACES)
def test_a_sphere_s_picture_is_the_outline_of_the_rays_that_touch_it(place) -> None:
    centre = np.array(place)
    seen = CAMERA.sphere(centre, RADIUS)
    # points of the circle in which the cone of rays touches the sphere, projected
    far = np.linalg.norm(centre)
    axis = centre / far
    side = np.cross(axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    turn = np.linspace(0.0, 2 * np.pi, 4001)[:-1, None]
    ring = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
    height = RADIUS / far * np.sqrt(far**2 - RADIUS**2)
    touched = axis * (far - RADIUS**2 / far) + height * ring
    u, v = np.array([CAMERA.project(one) for one in touched]).T
    assert seen.u == pytest.approx((u.max() + u.min()) / 2, abs=1e-3)
    assert seen.v == pytest.approx((v.max() + v.min()) / 2, abs=1e-3)
    area = 0.5 * abs(u @ np.roll(v, -1) - v @ np.roll(u, -1))
    assert seen.area == pytest.approx(area, rel=1e-5)
    assert CAMERA.centre(seen, RADIUS) == pytest.approx(centre, abs=1e-9)


def test_a_blob_is_where_its_pixels_are() -> None:
    picture = np.full((HEIGHT, WIDTH, 3), 130, np.uint8)
    assert red_blob(picture).area == 0.0
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    picture[(u - 100.0) ** 2 + (v - 60.0) ** 2 < 20.0**2] = 200, 60, 40
    picture[200:, :] = 30, 0, 0  # too dark for a colour
    picture[:10, :] = 250, 120, 140  # pale
    blob = red_blob(picture)
    assert (blob.u, blob.v) == pytest.approx((100.0, 60.0), abs=0.01)
    assert blob.area == pytest.approx(np.pi * 20.0**2, rel=0.01)
    assert blob.roundness == pytest.approx(1.0, abs=0.01)
    assert blob.inside
    half = picture.copy()
    half[:, 100:] = 130
    assert red_blob(half).roundness < 0.81
    two = picture.copy()
    two[100:140, 200:240] = 200, 60, 40
    assert red_blob(two).roundness < 0.3


@pytest.mark.parametrize(("down", "right"), [(0, 90), (239, 90), (90, 0), (90, 319)])
def test_a_blob_at_the_edge_is_said_to_be_cut(down: int, right: int) -> None:
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[80:100, 80:100, 0] = 200
    assert red_blob(picture).inside
    picture[down, right, 0] = 200
    assert not red_blob(picture).inside


# --------------------------------------------------------------------------- drawing


@pytest.fixture(scope="module")
def drawn() -> Any:
    camera = drawn_camera("eye", *SIZE)
    yield camera
    camera.close()


@pytest.mark.slow
def test_the_drawn_picture_shows_the_ball_where_the_geometry_says(drawn) -> None:
    geometry, random = Geometry(PUMA560.dh), np.random.default_rng(1)
    assert drawn.fovy == pytest.approx(FOVY)
    for _ in range(25):
        q = POSTURE + random.uniform(-0.3, 0.3, 6)
        hand = geometry.pose(q)
        eye = hand[:, 3] + hand[:, :3] @ EYE
        centre = random.uniform((-0.1, -0.08, 0.28), (0.1, 0.08, 0.5))
        blob = red_blob(drawn.take(q, ball=eye + hand[:, :3] @ centre))
        pose = np.column_stack((hand[:, :3], eye))
        assert drawn.pose == pytest.approx(pose, abs=1e-6)
        seen = CAMERA.sphere(centre, RADIUS)
        assert np.hypot(blob.u - seen.u, blob.v - seen.v) < 0.5
        assert blob.area == pytest.approx(seen.area, rel=0.02)
        assert blob.roundness > 0.98
        found = CAMERA.centre(seen._replace(u=blob.u, v=blob.v, area=blob.area), RADIUS)
        assert np.linalg.norm(found - centre) < 0.01 * centre[2]


@pytest.mark.slow
def test_a_camera_that_is_gone_takes_nothing_from_another(drawn) -> None:
    wanted = drawn.take(POSTURE, ball=AHEAD).copy()
    assert red_blob(wanted).area > 1000.0
    before = MujocoCamera(EXAMPLE / "scene.xml", "eye", *SIZE)
    assert np.array_equal(before.take(POSTURE, ball=AHEAD), wanted)
    after = MujocoCamera(EXAMPLE / "scene.xml", "eye", *SIZE)
    del before
    assert np.array_equal(after.take(POSTURE, ball=AHEAD), wanted)
    after.close()
    assert np.array_equal(drawn.take(POSTURE, ball=AHEAD), wanted)


def test_a_scene_without_that_camera_is_refused() -> None:
    pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")
    with pytest.raises(ParameterError, match=r"no camera eyes .*expected side or eye"):
        MujocoCamera(EXAMPLE / "scene.xml", "eyes", *SIZE)
    with pytest.raises(ParameterError, match="MuJoCo cannot read the scene"):
        MujocoCamera(EXAMPLE / "nothing.xml", "eye", *SIZE)


# -------------------------------------------------------------------------- the filter


@pytest.mark.parametrize("smooth", [0.0, 0.5, 0.9])
def test_an_even_motion_is_followed_without_error(smooth: float) -> None:
    point, speed = TrackedPoint(), np.array([0.1, -0.2, 0.05])
    assert not point.known
    times = np.cumsum(np.tile([0.04, 0.11], 150))
    for time in times:
        point.correct(speed * time, time, smooth)
    assert point.velocity == pytest.approx(speed, abs=1e-6)
    assert point.at(times[-1] + 0.3) == pytest.approx(speed * (times[-1] + 0.3))
    point.forget()
    point.correct(np.ones(3), times[-1] + 1.0, smooth)
    assert point.velocity == pytest.approx(np.zeros(3))
    assert point.at(times[-1] + 2.0) == pytest.approx(np.ones(3))


# -------------------------------------------------------------------------- the module


class Processor:
    """Looks without drawing, and answers some cycles later.

    Attributes:
        late: Asks of `wait` until a batch is done.
        runs: Whether the executive does.
        blind: What a picture shows in place of the ball.
    """

    late, runs = 2, True
    blind: Blob | None = None

    def __init__(self, name: str, library: str, *, task: Any) -> None:
        self.about = name, library, task
        self.left = 0
        self.batch: list[tuple[Any, ...]] = []
        self.finished = False
        self.handles = {name: SimpleNamespace(value=None) for name in ("seen", "q")}

    def translate(self, name: str) -> Any:
        return self.handles.get(name, name)

    def write(self, variable: Any, values: Any) -> None:
        self.batch.append((variable, np.array(values)))

    def call(self, routine: str, number: int) -> None:
        self.batch.append((routine, number))

    def read(self, variable: Any) -> None:
        self.batch.append((variable,))

    def wait(self, timeout: float) -> bool:
        assert timeout == 0.0
        if self.batch:
            assert not self.left
            (_, self.posture), (_, ball), (look, self.number), (seen,) = self.batch
            assert (look, seen) == ("look", self.handles["seen"])
            self.shown = self.show(ball)
            self.left, self.batch = self.late, []
            return False
        if self.left and self.runs:
            self.left -= 1
            if not self.left:
                self.handles["seen"].value = np.array([self.number, *self.shown])
        return not self.left

    def finish(self) -> None:
        self.finished = True

    def show(self, ball: Any) -> Blob:
        """Return what the picture has of a ball, by the pose of the hand now."""
        if self.blind:
            return self.blind
        hand = self.hand
        centre = hand[:, :3].T @ (ball - hand[:, 3]) - EYE
        return Blob(*CAMERA.sphere(centre, RADIUS), 1.0, 1.0)

    hand = HAND


PARAMS = {
    "spp": "camera",
    "library": "ball_camera.py",
    "size": SIZE,
    "fovy": FOVY,
    "eye": (*EYE, 0.0, 0.0, 0.0),
    "radius": RADIUS,
    "distance": DISTANCE,
    "angles": (-np.pi / 2, 0.0, -np.pi / 2),
}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench[VisualBall]:
    monkeypatch.setattr(visual_ball, "Spp", Processor)
    bench = Bench(
        VisualBall,
        params=PARAMS,
        ndof=6,
        freq=25,
        x=HAND,
        q=POSTURE,
        ball=BALL,
        x_des=HAND + 0.01,
    )
    bench.on()
    return bench


def processor(bench: Bench[VisualBall]) -> Any:
    return bench.module._spp


def said(bench: Bench[VisualBall]) -> list[str]:
    return [notice.text for notice in bench.notices()]


def test_the_hand_goes_to_before_the_ball(bench) -> None:
    assert np.array_equal(bench.outputs.x_des, HAND + 0.01), "until there is a picture"
    bench.step(n=10)
    assert bench.outputs.x_des == pytest.approx(HAND, abs=1e-6)
    assert bench.outputs.v == pytest.approx(np.zeros(6))
    way = np.array([0.05, 0.06, -0.07])
    bench.inputs.ball[:, 3] = AHEAD + way
    bench.step(n=60)
    moved = np.column_stack((TURN, HAND[:, 3] + way))
    assert bench.outputs.x_des == pytest.approx(moved, abs=1e-6)
    assert processor(bench).about == ("camera", "ball_camera.py", bench.task)
    assert processor(bench).posture == pytest.approx(POSTURE)
    assert said(bench) == []


@pytest.mark.parametrize("late", [1, 3, 5])
def test_a_ball_that_moves_evenly_is_where_it_is_expected(bench, late: int) -> None:
    """However late pictures come, and although the hand moves meanwhile."""
    processor(bench).late = late
    ball, hand = np.array([0.06, -0.1, 0.08]), np.array([0.05, -0.05, 0.1])
    for k in range(1, 120):
        now = 0.04 * k
        bench.inputs.ball[:, 3] = AHEAD + now * ball
        moved = np.column_stack((TURN, HAND[:, 3] + now * hand))
        bench.inputs.x = processor(bench).hand = moved
        bench.step()
    goal = AHEAD + now * ball - DISTANCE * TURN[:, 2]
    assert bench.outputs.x_des[:, 3] == pytest.approx(goal, abs=2e-4)
    assert bench.outputs.v == pytest.approx([*ball, 0.0, 0.0, 0.0], abs=1e-3)


def test_outputs_are_as_old_as_the_picture_that_they_come_from(bench) -> None:
    ages, numbers = [], []
    for _ in range(40):
        bench.step()
        ages.append(bench.output_age)
        numbers.append(bench.outputs.picture)
        assert bench.outputs.age == pytest.approx(ages[-1])
    assert set(np.round(ages[8:], 6)) == {0.08, 0.12}
    assert numbers == sorted(numbers)
    assert set(np.diff(numbers)) == {0, 1}


def test_between_two_pictures_the_reference_goes_on(monkeypatch) -> None:
    """It runs as often as who follows it; pictures are no more than EVERY allows."""
    monkeypatch.setattr(visual_ball, "Spp", Processor)
    fast = Bench(
        VisualBall,
        params={**PARAMS, "every": 0.1},
        ndof=6,
        freq=100,
        x=HAND,
        q=POSTURE,
        ball=BALL,
    )
    fast.on()
    places, numbers = [], []
    for _ in range(200):
        fast.inputs.ball[1, 3] += 0.001
        fast.step()
        places.append(fast.outputs.x_des[1, 3])
        numbers.append(fast.outputs.picture)
    assert set(np.diff(np.flatnonzero(np.diff(numbers[50:])))) == {10}
    assert np.diff(places[100:]) == pytest.approx(np.full(99, 0.001), abs=2e-4)


FAULTS = {
    "the picture shows no ball": Blob(0.0, 0.0, 0.0, 0.0, 0.0),
    "the edge of the picture cuts the ball": Blob(5.0, 90.0, 900.0, 0.95, 0.0),
    "what the picture shows is not round": Blob(90.0, 90.0, 900.0, 0.3, 1.0),
}


def moving(bench: Bench[VisualBall], n: int) -> None:
    """Let the ball go on, at 0.1 m/s."""
    for _ in range(n):
        bench.inputs.ball[1, 3] += 0.004
        bench.step()


def check_standing_and_back(bench: Bench[VisualBall], why: str) -> None:
    """Check that the reference goes on, stands, and follows again."""
    moving(bench, 8)
    assert bench.outputs.v[1] == pytest.approx(0.1, abs=0.01), "not lost yet"
    assert said(bench) == []
    moving(bench, 10)
    stands = bench.outputs.x_des.copy()
    for _ in range(5):
        moving(bench, 4)
        assert np.array_equal(bench.outputs.x_des, stands)
        assert np.array_equal(bench.outputs.v, np.zeros(6))
    assert bench.output_age == bench.outputs.age > 1.0, "for those who have a limit"
    assert said(bench) == [f"{why}: X_DES stands still"]


@pytest.mark.parametrize("why", FAULTS)
def test_without_a_ball_it_stands_still_and_says_why(bench, why: str) -> None:
    moving(bench, 40)
    processor(bench).blind = FAULTS[why]
    before = bench.outputs.picture
    check_standing_and_back(bench, why)
    assert bench.outputs.picture > before
    processor(bench).blind = None
    moving(bench, 40)
    assert bench.outputs.v[1] == pytest.approx(0.1, abs=0.01)
    assert bench.outputs.age < 0.2
    assert said(bench) == []


def test_when_the_executive_is_dead_it_stands_still_until_another_runs(bench) -> None:
    moving(bench, 40)
    processor(bench).runs = False
    check_standing_and_back(bench, "no new picture has come")
    processor(bench).left = 0  # the batch was not done: the executive started again
    processor(bench).runs = True
    moving(bench, 40)
    assert bench.outputs.v[1] == pytest.approx(0.1, abs=0.01)
    assert said(bench) == []


def test_pictures_of_before_it_was_turned_off_are_not_used(bench) -> None:
    processor(bench).late = 5
    bench.step(n=2)
    bench.off()
    assert np.array_equal(bench.outputs.v, np.zeros(6))
    bench.inputs.ball[:, 3] = AHEAD + 0.05
    bench.outputs.x_des = HAND + 0.02
    bench.on()
    bench.step(n=7)
    assert np.array_equal(bench.outputs.x_des, HAND + 0.02)
    bench.step(n=10)
    assert bench.outputs.x_des[:, 3] == pytest.approx(HAND[:, 3] + 0.05, abs=1e-6)


def test_a_successor_goes_on_from_the_velocity(bench) -> None:
    moving(bench, 40)
    bench.off(handover=True)
    assert bench.outputs.v[1] == pytest.approx(0.1, abs=0.01)
    bench.kill()
    assert processor(bench).finished


def test_while_the_hand_s_pose_is_too_old_it_stands_still(bench) -> None:
    moving(bench, 40)
    stands = bench.outputs.x_des.copy()
    bench.ages["x"] = 0.4
    moving(bench, 10)
    assert np.array_equal(bench.outputs.x_des, stands)
    assert np.array_equal(bench.outputs.v, np.zeros(6))


def test_parameters_may_change_while_it_runs(bench) -> None:
    bench.step(n=10)
    bench.set("distance", 0.3)
    bench.step(n=5)
    nearer = HAND[:, 3] + 0.1 * TURN[:, 2]
    assert bench.outputs.x_des[:, 3] == pytest.approx(nearer, abs=1e-6)
    with pytest.raises(MethodError, match="parameter eye has the wrong number"):
        bench.set("eye", (0.0, 0.0, 0.06))
    with pytest.raises(MethodError, match="parameter spp is read when"):
        bench.set("spp", "other")


def test_the_example_s_camera_is_calibrated_as_its_scene_says() -> None:
    rmod = read_rmod(EXAMPLE / "eye.rmod")
    found = decode_params(Library().load(rmod.module).cls, rmod.local)
    for name, value in PARAMS.items():
        assert getattr(found, name) == pytest.approx(value, abs=1e-6), name
