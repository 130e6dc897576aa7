"""`mppi_arm`: its kernels against plain loops, and the module on a bench."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pbonet.config import Library
from pbonet.errors import MethodError
from pbonet.io import RobotModel, no_devices
from pbonet.io.mppi import sizes as at
from pbonet.io.spp import kernel_library
from pbonet.io.spp.numpy_back_end import NumpyBackEnd
from pbonet.io.spp.torch_back_end import TorchBackEnd
from pbonet.io.spp.warp_back_end import WarpBackEnd
from pbonet.modules.trajectories.mppi_arm import MppiArm, axes_of
from pbonet.testing import Bench

PANDA = Path(__file__).parents[3] / "examples" / "panda"
HOME = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.785398])
MOST = np.array([8.0, 8, 8, 8, 10, 10, 10])
EXAMPLE = PANDA.parent / "mppi"
LIBRARY = kernel_library.load("pbonet.io.mppi.kernels")


def model():
    return RobotModel("panda.urdf", [PANDA])


# ---------------------------------------------------------------- the kernels


def problem():
    """Return values of all variables: an arm that moves, a goal, and a ball."""
    arm = model()
    found = {k: np.zeros(one.shape, one.dtype) for k, one in LIBRARY.variables.items()}
    found["joints"][:, :7] = arm.lower, arm.upper, arm.velocity, MOST, HOME
    found["axes"], found["tip"] = axes_of(arm, "hand")
    found["axes"][6, 6:] = 0.1, 0.0, 0.2  # the last joint slides as it turns
    found["goal"][:] = 0.5, 0.3, 0.4
    found["state"][0, :7], found["state"][1, :7] = HOME, 0.4
    found["state"][0, 3] = -0.15  # near its limit
    k = found["settings"]
    k[at.STEP], k[at.NOISE], k[at.KEEP] = 0.02, 0.7, 0.6
    k[at.FLOOR], k[at.NEAR], k[at.TEMPERATURE] = 0.05, 0.8, 0.2
    k[at.DISTANT], k[at.END], k[at.SPEED] = 1.0, 5.0, 0.02
    k[at.EFFORT], k[at.POSTURE], k[at.INSIDE] = 1e-2, 0.02, 20.0
    k[at.BALL : at.BALL + 4] = 0.44, 0.0, 0.75, 0.3
    found["plan"][:5, :7] = 2.0, -1.0, 0.5, 3.0, 0.0, -2.0, 1.0
    return found


def word(x):
    for shift, odd in ((16, at.ODD[0]), (15, at.ODD[1])):
        x ^= x >> shift
        x = x * odd % 2**32
    return x ^ x >> 16


def normal(seed, t, j, r, steps, rollouts):  # noqa: PLR0917
    place = (t // 2 * 7 + j) * rollouts + r
    second = (steps + 1) // 2 * 7 * rollouts
    u, v = (word(i ^ word(seed)) >> 8 for i in (place, place + second))
    size, turn = math.sqrt(-2 * math.log((u + 0.5) / 2**24)), math.tau * v / 2**24
    return size * (math.sin(turn) if t % 2 else math.cos(turn))


def place_of(one, q):
    p = one["tip"].astype(float)
    for j in reversed(range(7)):
        axis, point, way = one["axes"][j].astype(float).reshape(3, 3)
        arm = p - point
        along = axis * (axis @ arm)
        turned = along + math.cos(q[j]) * (arm - along)
        p = point + turned + math.sin(q[j]) * np.cross(axis, arm) + q[j] * way
    return p


def limited(q, v, a, limits, dt):
    """Return the velocity behind a step."""
    low, high, fast, most = limits
    up, down = (
        most * (math.sqrt(dt * dt + 2 * max(room, 0.0) / most) - dt)
        for room in (high - q, q - low)
    )
    wish = max(min(v + dt * a, up, fast), -min(down, fast))
    return min(max(wish, v - dt * most), v + dt * most)


def rollout(one, plan, seed, r, rollouts):
    """Return what a rollout tries, and its cost: the law in plain numbers."""
    k, steps = one["settings"].astype(float), len(plan)
    limits = one["joints"][:, :7].astype(float)
    q, v = (list(row) for row in one["state"][:, :7].astype(float))
    goal, ball = one["goal"].astype(float), k[at.BALL : at.BALL + 3]
    start = np.linalg.norm(place_of(one, q) - goal)
    size = k[at.NOISE] * min(1.0, k[at.FLOOR] + start / k[at.NEAR]) * (r > 0)
    tried, change, cost, far = np.zeros((steps, 7)), [0.0] * 7, 0.0, 0.0
    for t in range(steps):
        for j in range(7):
            _, _, fast, most, posture = limits[:, j]
            new = normal(seed, t, j, r, steps, rollouts)
            kept = k[at.KEEP] * change[j] + math.sqrt(1 - k[at.KEEP] ** 2) * new
            change[j] = kept if t else new
            a = min(max(plan[t, j] + size * most * change[j], -most), most)
            v[j] = limited(q[j], v[j], a, limits[:4, j], k[at.STEP])
            q[j] += k[at.STEP] * v[j]
            tried[t, j] = a
            cost += k[at.EFFORT] * (a / most) ** 2 + k[at.SPEED] * (v[j] / fast) ** 2
            cost += k[at.POSTURE] * (q[j] - posture) ** 2
        place = place_of(one, q)
        far = np.linalg.norm(place - goal)
        inside = max(k[at.BALL + 3] - np.linalg.norm(place - ball), 0.0)
        cost += k[at.DISTANT] * far + k[at.INSIDE] * inside
    return tried, cost + k[at.END] * far


def expected(one, steps, rollouts, seed, shift):
    """Return the plan that an update should make."""
    old = np.vstack((one["plan"][:steps, :7], np.zeros((steps + 2, 7)))).astype(float)
    whole, part = min(int(shift), steps), shift - int(shift)
    plan = (1 - part) * old[whole : whole + steps]
    plan += part * old[whole + 1 : whole + 1 + steps]
    tries, costs = zip(
        *(rollout(one, plan, seed, r, rollouts) for r in range(rollouts)), strict=True
    )
    over = np.array(costs) - min(costs)
    weight = np.exp(-over / (one["settings"][at.TEMPERATURE] * over.mean()))
    return np.tensordot(weight / weight.sum(), np.array(tries), 1)


def needs(package, device):
    there = find_spec(package) is not None
    there = there and (device == "cpu" or Path("/dev/nvidiactl").exists())
    marks = [pytest.mark.skipif(not there, reason=f"there is no {package} on {device}")]
    return [*marks, pytest.mark.gpu] if device != "cpu" else marks


BACK_ENDS = [NumpyBackEnd] + [
    pytest.param(lambda m=make, d=device: m(d), marks=needs(package, device), id=label)
    for package, make in (("warp", WarpBackEnd), ("torch", TorchBackEnd))
    for device in ("cpu", "cuda:0")
    for label in [f"{package} on {device}"]
]


def run(back_end, values, calls):
    """Return the plans that several updates make, as a batch makes them."""
    arrays = {k: back_end.make(one) for k, one in LIBRARY.variables.items()}
    for name, value in values.items():
        back_end.write(arrays[name], value)
    m = SimpleNamespace(**arrays, local=SimpleNamespace(), device=back_end.said)
    plans = []
    for call in calls:
        LIBRARY.routines["update"][back_end.name](m, 7, *call)
        back_end.read(arrays["plan"])
        back_end.finish()
        plans.append(back_end.taken(arrays["plan"]).copy())
    return plans


CALLS = [(4, 140, 3, 1.3), (4, 140, 4, 0.0), (5, 2, 5, 9.0)]
"""Steps, rollouts, seed and shift of updates that follow each other."""


@pytest.fixture(scope="module")
def law():
    values, found = problem(), []
    for steps, *call in CALLS:
        plan = np.zeros_like(values["plan"])
        plan[:steps, :7] = expected(values, steps, *call)
        values["plan"] = plan
        found.append(plan)
    return found


@pytest.mark.filterwarnings("ignore:Kernel cache artifacts")  # of another Warp
@pytest.mark.parametrize("make", BACK_ENDS)
def test_every_back_end_makes_the_plan_of_the_law(make, law):
    plans = run(make(), problem(), CALLS)
    assert np.abs(plans[0]).max() > 1.0
    for plan, right in zip(plans, law, strict=True):
        # Numbers have 24 bits, and costs of 10 that differ by 0.1 are compared.
        assert np.abs(plan - right).max() < 2e-5 * MOST.max()


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Kernel cache artifacts")  # of another Warp
@pytest.mark.parametrize("make", [one for one in BACK_ENDS[1:] if "cuda" in one.id])
def test_many_rollouts_on_a_gpu_make_the_plan_of_numpy(make):
    calls = [(30, 16_384, 3, 1.0), (30, 16_384, 4, 0.5)]
    ours, theirs = (run(b, problem(), calls) for b in (NumpyBackEnd(), make()))
    assert np.abs(np.array(ours) - np.array(theirs)).max() < 1e-4


def test_the_axes_place_the_hand_as_pinocchio_does():
    arm, pose = model(), np.empty((3, 4))
    axes, tip = axes_of(arm, "hand")
    draws = np.random.default_rng(1).random((20, arm.n))
    for q in arm.lower + (arm.upper - arm.lower) * draws:
        arm.pose(q, arm.frame("hand"), pose)
        there = place_of({"axes": axes, "tip": tip}, q)
        assert there == pytest.approx(pose[:, 3], abs=1e-6)


# ----------------------------------------------------------------- the module


GOAL = np.array([0.5, 0.25, 0.45])


def bench(**params):
    given = {"rollouts": 64, "horizon": 16, "step": 0.03, "acceleration": tuple(MOST)}
    with no_devices("this is a test"):
        made = Bench(
            MppiArm,
            params={"urdf": "panda.urdf", "frame": "hand", "posture": tuple(HOME)}
            | given
            | params,
            ndof=7,
            q=HOME,
            q_ref=HOME,
            goal=GOAL,
            freq=100,
            library=[PANDA],
        )
    made.on()
    return made


class Arm:
    """An arm that follows its reference exactly, and what it does."""

    def __init__(self, made):
        self.bench, self.model = made, model()
        self.q, self.v = [], []
        self.follows = True

    def step(self, n):
        for _ in range(n):
            self.bench.step()
            self.q.append(np.array(self.bench.outputs.q_ref))
            self.v.append(np.array(self.bench.outputs.qd_ref))
            if self.follows:
                self.bench.inputs.q = self.q[-1]
                self.bench.inputs.qd = self.v[-1]

    @property
    def far(self):
        pose = np.empty((3, 4))
        self.model.pose(self.q[-1], self.model.frame("hand"), pose)
        return np.linalg.norm(pose[:, 3] - self.bench.inputs.goal)


@pytest.mark.slow
def test_the_hand_reaches_its_goal_within_all_limits():
    arm = Arm(bench())
    arm.step(200)
    assert arm.far < 0.02
    for goal in ([0.3, -0.2, 0.9], [1.5, 0.0, 0.5]):  # the last is out of reach
        arm.bench.inputs.goal = goal
        arm.step(100)
    q, v, known = np.array(arm.q), np.array(arm.v), arm.model
    assert np.all(q >= known.lower - 1e-9)
    assert np.all(q <= known.upper + 1e-9)
    assert np.all(np.abs(v) <= known.velocity + 1e-9)
    assert np.abs(v).max() > 2.0, "it is fast"
    change = np.abs(np.diff(v, axis=0)) / 0.01
    assert np.all(change <= MOST + 1e-6)
    assert np.diff(q, axis=0) == pytest.approx(v[1:] * 0.01)


def stops(arm):
    """Let it brake; check that it holds then."""
    arm.step(40)
    assert not arm.v[-1].any()
    held = arm.q[-1]
    arm.step(5)
    assert np.array_equal(arm.q[-1], held)
    change = np.abs(np.diff(np.array(arm.v), axis=0)) / 0.01
    assert np.all(change <= MOST + 1e-6)


def test_without_a_goal_it_brakes_tells_once_and_goes_on():
    arm = Arm(bench())
    arm.step(20)
    assert np.abs(arm.v[-1]).max() > 0.3
    arm.bench.inputs.goal = [np.nan, 0.0, 0.0]
    stops(arm)
    (notice,) = arm.bench.notices()
    assert notice.text == "X_GOAL is not finite: the arm stops"
    arm.bench.inputs.goal = GOAL
    arm.step(10)
    assert arm.v[-1].any()


def test_without_results_it_brakes_says_their_age_and_goes_on(monkeypatch):
    arm = Arm(bench())
    way = arm.bench.module._spp._way
    with monkeypatch.context() as lost:
        lost.setattr(way, "receive", lambda _: None)
        arm.step(10)
        assert not arm.v[-1].any(), "it holds until there is a plan"
        assert arm.bench.outputs.age == pytest.approx(0.1, abs=0.011)
    arm.step(30)
    assert arm.bench.outputs.age < 0.03
    assert np.abs(arm.v[-1]).max() > 0.3
    with monkeypatch.context() as lost:
        lost.setattr(way, "receive", lambda _: None)
        arm.step(15)
        assert np.abs(arm.v[-1]).max() > 0.1, "a plan lasts LATE"
        stops(arm)
        assert arm.bench.outputs.age > 0.5
    arm.step(10)
    assert arm.v[-1].any()


def test_a_plan_of_before_is_not_followed_when_it_is_turned_on_again():
    arm = Arm(bench())
    arm.step(20)
    arm.bench.off()
    arm.bench.module._spp._way.receive = lambda _: None
    arm.bench.on()
    arm.step(1)
    assert not arm.v[-1].any()
    assert arm.bench.outputs.age < 0.02


def test_the_reference_stays_within_lead_of_an_arm_that_does_not_follow():
    arm = Arm(bench(lead=0.1))
    arm.follows = False
    arm.step(150)
    off = np.abs(np.array(arm.q) - HOME).max()
    assert 0.05 < off <= 0.1 + 1e-9


def test_the_hand_keeps_out_of_a_ball():
    way = {}
    for weight in (0.0, 20.0):
        arm = Arm(bench(ball=(0.46, 0.13, 0.52, 0.08), inside=weight))
        centre, depth = np.array([0.46, 0.13, 0.52]), []
        pose = np.empty((3, 4))
        for _ in range(80):
            arm.step(1)
            arm.model.pose(arm.q[-1], arm.model.frame("hand"), pose)
            depth.append(0.08 - np.linalg.norm(pose[:, 3] - centre))
        way[weight] = max(depth)
    assert way[0.0] > 0.03
    assert way[20.0] < 0.015


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"ball": (1.0, 2.0)}, "parameter ball has the wrong number of values"),
        ({"frame": "nose"}, "the robot has no frame nose"),
    ],
)
def test_what_does_not_fit_is_refused(params, text):
    with pytest.raises(MethodError) as caught:
        bench(**params)
    assert text in str(caught.value)


# ------------------------------------------------------- the goals of the example


def test_the_next_goal_comes_when_one_is_reached_or_given_up():
    loaded = Library([EXAMPLE, PANDA]).load("goals")
    given = {"urdf": "panda.urdf", "frame": "hand", "count": 3, "patience": 1.0}
    made = Bench(loaded.cls, params=given, ndof=7, freq=100, library=[PANDA])
    made.on()
    seen = [tuple(made.outputs.goal)]
    made.inputs.x[:, 3] = seen[0] + np.array([0.0, 0.0, 0.019])
    made.step(n=19)
    assert not made.outputs.goals.any()
    made.step(n=2)
    assert list(made.outputs.goals) == [1.0, 0.0]
    seen.append(tuple(made.outputs.goal))
    made.step(n=101)
    assert list(made.outputs.goals) == [1.0, 1.0]
    seen.append(tuple(made.outputs.goal))
    made.step(n=101)
    assert list(made.outputs.goals) == [1.0, 2.0]
    assert tuple(made.outputs.goal) == seen[2], "the last one stays"
    assert len(set(seen)) == 3
    assert all(goal[0] > 0.3 and goal[2] > 0.15 for goal in seen)
