"""`ros_trajectory` on a bench: the link is real, and the test is its bridge."""

import numpy as np
import pytest

from pbonet import Signal, State, tbuf, xm
from pbonet.io import no_devices
from pbonet.modules.trajectories.otg import Otg
from pbonet.modules.trajectories.ros_trajectory import RosTrajectory
from pbonet.modules.trajectories.traj_play import hermite
from pbonet.svar import now_ns
from pbonet.testing import Bench

NAN = float("nan")
INF = float("inf")
POINTS = 4


@pytest.fixture(autouse=True)
def home():
    xm.live_on("ros2", domain="d")
    yield
    xm.live_on("local")


@pytest.fixture
def bench():
    params = {"link": "ros2:way", "points": POINTS}
    made = Bench(RosTrajectory, params=params, ndof=2, freq=100.0)
    made.outputs.y = [1.0, 2.0]
    made.on()
    yield made
    made.kill()


@pytest.fixture
def send():
    form = np.dtype([("goal", "i8"), ("rows", "f8", (POINTS, 7))])
    with tbuf.Writer("way", form) as writer:

        def put(*points, age=0.0, goal=0):
            writer.value["goal"], writer.value["rows"][:] = goal, NAN
            for row, point in zip(writer.value["rows"], points, strict=False):
                row[: len(point)] = point
            writer.write(now_ns() - round(age * 1e9))

        yield put


def steps(bench, count):
    for _ in range(count):
        bench.step()


def test_it_rests_until_a_trajectory_comes(bench, send):
    steps(bench, 5)
    assert bench.outputs.y.tolist() == [1.0, 2.0]
    send((0.1, 3.0, 4.0))
    steps(bench, 11)
    assert bench.outputs.y.tolist() == [3.0, 4.0]
    assert bench.outputs.y_dot.tolist() == [0.0, 0.0]
    assert bench.task.signals & Signal.FINISH


def test_it_passes_the_points_with_their_velocities(bench, send):
    send((0.0, 9.0, 9.0), (0.1, 2.0, 2.5, 7.0, -1.0), (0.3, 4.0, 2.0, 0.0, 0.0))
    found = []
    for _ in range(30):
        bench.step()
        found.append((bench.outputs.y.copy(), bench.outputs.y_dot.copy()))
    np.testing.assert_allclose(found[9], [[2.0, 2.5], [7.0, -1.0]], atol=1e-9)
    begin, goal = (np.array([[1.0, 2.0], [0.0, 0.0]]), np.array([[2.0, 2.5], [7, -1]]))
    np.testing.assert_allclose(found[4], hermite(0.5, 0.1, begin, goal), atol=1e-9)
    np.testing.assert_allclose(found[-1], [[4.0, 2.0], [0.0, 0.0]], atol=1e-9)


def test_a_stream_is_followed_by_otg_within_its_limits(bench, send):
    pytest.importorskip("ruckig")
    limits = {"velocity": (0.8,), "acceleration": (8.0,), "jerk": (80.0,)}
    follower = Bench(Otg, params=limits, ndof=2, freq=100.0)
    follower.outputs.q = bench.outputs.y
    follower.on()
    way, fastest = np.linspace(0.0, 1.0, 12), 0.0
    for k in range(len(way) - 2):  # as a sender of servo commands does
        send(*((0.1 * (i + 1), 1.0 + way[k + i], 2.0 - way[k + i]) for i in (1, 2)))
        for _ in range(10):
            bench.step()
            follower.inputs.q_des = bench.outputs.y
            follower.step()
            fastest = max(fastest, abs(follower.outputs.q_dot).max())
            assert abs(follower.outputs.q - bench.outputs.y).max() < 0.4
    assert fastest == pytest.approx(0.8), "the stream is faster"
    for _ in range(200):
        bench.step()
        follower.inputs.q_des = bench.outputs.y
        follower.step()
    np.testing.assert_allclose(follower.outputs.q, [2.0, 1.0], atol=1e-9)
    follower.kill()


def test_velocities_that_are_not_given_are_differences(bench, send):
    send((0.1, 2.0, 2.0), (0.2, 3.0, 2.0))
    steps(bench, 10)
    np.testing.assert_allclose(bench.outputs.y_dot, [10.0, 0.0], atol=1e-9)


def test_a_new_one_begins_where_it_stands_without_a_jump(bench, send):
    send((1.0, 3.0, 2.0))
    steps(bench, 50)
    before = bench.outputs.y.copy(), bench.outputs.y_dot.copy()
    assert before[1][0] > 1.0
    send((2.0, 0.0, 2.0))
    bench.step()
    np.testing.assert_allclose(bench.outputs.y, before[0] + 0.01 * before[1], atol=5e-3)
    np.testing.assert_allclose(bench.outputs.y_dot, before[1], atol=0.5)
    steps(bench, 200)
    assert bench.outputs.y.tolist() == [0.0, 2.0]


def test_one_without_points_stops(bench, send):
    send((1.0, 3.0, 2.0))
    steps(bench, 50)
    stands = bench.outputs.y.copy()
    send()
    steps(bench, 5)
    assert (bench.outputs.y == stands).all()
    assert not bench.outputs.y_dot.any()


@pytest.mark.parametrize(
    "points",
    [
        [(0.2, 3.0, 3.0), (0.1, 4.0, 4.0)],
        [(0.1,)],
        [(0.0, 3.0, 3.0)],
        [(0.1, NAN, 1.0)],
        [(0.1, INF, 1.0)],
        [(0.1, 3.0, 1.0, -INF, 0.0)],
    ],
)
def test_one_that_cannot_be_is_warned_of_and_the_old_one_goes_on(bench, send, points):
    send((0.2, 3.0, 4.0))
    steps(bench, 10)
    send(*points)
    steps(bench, 11)
    assert bench.task.nwarnings == 1
    assert "was not followed" in bench.task.errmsg
    assert bench.outputs.y.tolist() == [3.0, 4.0]


def test_what_came_while_it_was_off_is_not_followed(bench, send):
    bench.off()
    send((0.1, 3.0, 4.0))
    bench.on()
    steps(bench, 20)
    assert bench.outputs.y.tolist() == [1.0, 2.0]


def test_what_came_while_it_ran_stable_is_not_followed(bench, send):
    """The robot would start by itself as soon as the fault is over."""
    send((1.0, 3.0, 4.0))
    steps(bench, 50)
    bench.module.stable(0.01)
    stands = bench.outputs.y.copy()
    send((0.1, 5.0, 6.0))
    bench.module.stable(0.01)
    steps(bench, 20)
    assert (bench.outputs.y == stands).all()
    assert not bench.outputs.y_dot.any()
    assert bench.task.nwarnings == 0
    send((0.1, 3.0, 4.0))
    steps(bench, 11)
    assert bench.outputs.y.tolist() == [3.0, 4.0]


def test_one_that_comes_too_late_is_not_followed_and_one_that_stops_is(bench, send):
    send((0.2, 3.0, 4.0))
    steps(bench, 10)
    send((0.1, 9.0, 9.0), age=2.0)
    steps(bench, 5)
    assert bench.task.nwarnings == 1
    assert "s old (MAXAGE 0.5)" in bench.task.errmsg
    assert 1.0 < bench.outputs.y[0] < 3.0
    stands = bench.outputs.y.copy()
    send(age=2.0)
    steps(bench, 20)
    assert (bench.outputs.y == stands).all()


def test_a_goal_ends_when_its_bridge_is_silent_and_goes_on_no_more(bench, send):
    """The bridge alone can cancel it, and see that it leaves its path."""
    way = 10.0, 3.0, 4.0
    send(way, goal=7)
    for _ in range(5):
        steps(bench, 90)
        before = bench.outputs.y.copy()
        send(way, goal=7)
    bench.step()
    assert bench.outputs.y[0] > before[0] > 1.0, "it did not begin again"
    assert bench.outputs.newest[0] == 7
    assert bench.outputs.newest[1] > 0
    steps(bench, 101)
    stands = bench.outputs.y.copy()
    assert not bench.outputs.y_dot.any()
    assert bench.outputs.newest.tolist() == [7.0, -1.0]
    assert "is silent for 1.01 s (SILENT 1)" in bench.task.errmsg
    send(way, goal=7)
    steps(bench, 200)
    assert (bench.outputs.y == stands).all()
    assert bench.task.nwarnings == 1
    send((0.1, 5.0, 6.0), goal=8)
    steps(bench, 11)
    assert bench.outputs.y.tolist() == [5.0, 6.0]


def test_a_goal_that_was_there_before_on_is_not_followed_when_it_is_repeated(
    bench, send
):
    way = 1.0, 3.0, 4.0
    bench.off()
    send(way, goal=7)
    bench.on()
    send(way, goal=7)
    steps(bench, 20)
    assert bench.outputs.y.tolist() == [1.0, 2.0]
    assert bench.outputs.newest.tolist() == [7.0, -1.0]


def test_a_message_of_a_topic_needs_no_bridge_that_goes_on(bench, send):
    send((3.0, 3.0, 4.0))
    steps(bench, 301)
    assert bench.outputs.y.tolist() == [3.0, 4.0]


def test_a_simulation_opens_no_link(shared_memory):
    with no_devices("this is a simulation"):
        bench = Bench(RosTrajectory, params={"link": "ros2:way"}, ndof=2)
    bench.on()
    steps(bench, 3)
    assert bench.state is State.ON
    assert list(shared_memory.iterdir()) == []
