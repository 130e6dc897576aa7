"""A FollowJointTrajectory action; the test is its client, and runs `ros_trajectory`."""

from __future__ import annotations

import os
import time
import uuid
from concurrent.futures import Future
from queue import Queue
from types import SimpleNamespace

import numpy as np
import pytest

from pbonet import xm
from pbonet.config.model import Variable
from pbonet.errors import ConfigError
from pbonet.modules.trajectories.ros_trajectory import RosTrajectory
from pbonet.ros2 import trajectory_action
from pbonet.ros2.message_types import FOLLOW, MessageTypes, set_stamp
from pbonet.ros2.repeated_warnings import Warnings
from pbonet.ros2.topics_file import Action
from pbonet.ros2.trajectory_action import Status, TrajectoryAction, check
from pbonet.svar import Table
from pbonet.testing import Bench

pytest.importorskip("rosbags")
JOINTS = ["lift", "turn"]
ABOUT = Action(
    name="follow",
    link="way",
    joints=JOINTS,
    desired="Q_DES",
    actual="Q_MEZ",
    points=4,
    feedback_hz=200.0,
)
VARIABLES = [
    Variable(name="TRAJ", type="double", nelem=2, units="mixed"),
    Variable(name="Q_DES", type="double", nelem=2, units="rad"),
    Variable(name="Q_MEZ", type="double", nelem=2, units="rad"),
]
FAR = 60.0


@pytest.fixture(scope="module")
def types():
    made = MessageTypes()
    made.add_following()
    return made


@pytest.fixture(autouse=True)
def home():
    xm.live_on("ros2", domain="d")
    yield
    xm.live_on("local")


class Client:
    """Stands for the node: calls the services, and gets what is published."""

    def __init__(self, types):
        self.types, self.calls, self.queues = types, {}, {}
        self.got = {"feedback": Queue(), "status": Queue()}

    def name_of(self, name):
        return f"/arm/{name}"

    def queue(self, name):
        return name

    def publisher(self, topic, kind, _qos):
        got = self.got[topic.rpartition("/")[2]]
        return SimpleNamespace(
            put=lambda data, _stamp: got.put(self.types.decode(kind, data))
        )

    def serve(self, name, kind, answer, requests):
        self.calls[name.rpartition("/")[2]] = kind, answer
        self.queues[name.rpartition("/")[2]] = requests

    def call(self, name, **fields):
        kind, answer = self.calls[name]
        request = self.types.new(f"{kind}_Request")
        for key, value in fields.items():
            setattr(request, key, value)
        return answer(request)

    def send(self, *points, names=JOINTS, goal_id=None, **fields):
        """Send a goal of (time, positions); return its identity, and if accepted."""
        goal = self.types.new(f"{FOLLOW}_Goal")
        goal.trajectory.joint_names = list(names)
        for at, positions in points:
            point = self.types.new("trajectory_msgs/msg/JointTrajectoryPoint")
            set_stamp(point.time_from_start, round(at * 1e9))
            point.positions = np.array(positions, float)
            goal.trajectory.points.append(point)
        for path, value in fields.items():
            owner, name = goal, path
            if path == "stamp":
                set_stamp(goal.trajectory.header.stamp, value)
                continue
            if path == "velocities":
                goal.trajectory.points[-1].velocities = np.array(value)
                continue
            setattr(owner, name, value)
        goal_id = goal_id or self.identity(uuid.uuid4().bytes)
        return goal_id, self.call("send_goal", goal_id=goal_id, goal=goal).accepted

    def identity(self, data):
        made = self.types.new("unique_identifier_msgs/msg/UUID")
        made.uuid = np.frombuffer(data, np.uint8)
        return made

    def tolerance(self, name, **bounds):
        made = self.types.new("control_msgs/msg/JointTolerance")
        made.name = name
        for key, value in bounds.items():
            setattr(made, key, value)
        return [made]

    def result(self, goal_id):
        return self.call("get_result", goal_id=goal_id)

    def cancel(self, goal_id=None, stamp_ns=0):
        info = self.types.new("action_msgs/msg/GoalInfo")
        info.goal_id = goal_id or info.goal_id
        set_stamp(info.stamp, stamp_ns)
        return self.call("cancel_goal", goal_info=info)


class Arm:
    """The task that follows, and the table that it writes."""

    def __init__(self):
        self.bench = Bench(
            RosTrajectory,
            params={"link": "ros2:way", "points": 4, "silent": FAR},
            ndof=2,
            freq=100.0,
        )
        self.bench.outputs.y = [1.0, 2.0]
        self.bench.on()
        self.table = Table.create("d.arm", VARIABLES)
        self.local = self.table.local(
            "follow", os.getpid(), outvar=["TRAJ", "Q_DES", "Q_MEZ"]
        )
        self.local.claim()
        self.miss = np.zeros(2)
        self.step()

    def sent(self):
        """Return the number of the newest record of the link."""
        return self.bench.module._link.written

    def step(self, *, rests=False, number=None):
        """Do a cycle; the arm is where it is to be, but for `miss`.

        With a number it has reached the end of that record.
        """
        if rests:
            self.bench.module.stable(0.01)
        else:
            self.bench.step()
        module = self.bench.module
        self.local.array("TRAJ")[:] = (number, 0.0) if number else module.newest
        self.local.array("Q_DES")[:] = module.y
        self.local.array("Q_MEZ")[:] = module.y + self.miss
        assert self.local.commit() == 0

    def until(self, condition, **how):
        """Do cycles until something is true; return it."""
        end = time.monotonic() + FAR
        while not (found := condition()):
            assert time.monotonic() < end
            self.step(**how)
            time.sleep(0.002)
        return found

    def result(self, waits):
        """Do cycles until a goal has a result; return that."""
        assert isinstance(waits, Future), waits
        self.until(waits.done)
        response = waits.result()
        return Status(response.status), response.result


@pytest.fixture
def arm():
    made = Arm()
    yield made
    made.bench.kill()
    made.table.destroy()


@pytest.fixture
def told():
    return []


@pytest.fixture
def client(types, arm, told):  # noqa: ARG001 - the table must be there
    made = Client(types)
    layout = Table.layout_of(VARIABLES)
    action = TrajectoryAction(made, ABOUT, "d.arm", layout, Warnings(told.append))
    action.open()
    made.close = action.close
    yield made
    action.close()


def test_a_goal_is_followed_to_its_end(arm, client) -> None:
    goal, accepted = client.send(
        (0.1, [4.0, 3.0]), (0.2, [6.0, 5.0]), names=["turn", "lift"]
    )
    assert accepted
    waits = client.result(goal)
    status, result = arm.result(waits)
    assert (status, result.error_code) == (Status.SUCCEEDED, 0)
    assert arm.bench.outputs.y.tolist() == [5.0, 6.0]
    its = client.got["feedback"].get(timeout=FAR)
    assert bytes(its.goal_id.uuid) == bytes(goal.uuid)
    its = its.feedback
    assert its.joint_names == JOINTS
    assert its.desired.positions.tolist() == its.actual.positions.tolist()
    assert its.error.positions.tolist() == [0.0, 0.0]
    states = [client.got["status"].get(timeout=FAR).status_list for _ in range(2)]
    assert [one[0].status for one in states] == [Status.EXECUTING, Status.SUCCEEDED]
    assert bytes(states[1][0].goal_info.goal_id.uuid) == bytes(goal.uuid)
    again = client.result(goal)
    assert (again.status, again.result.error_code) == (Status.SUCCEEDED, 0)
    assert client.result(client.identity(bytes(16))).status == Status.UNKNOWN


@pytest.mark.parametrize(
    ("points", "fields", "why"),
    [
        ([], {}, "its times do not grow"),
        ([(0.2, [0, 0]), (0.1, [1, 1])], {}, "its times do not grow"),
        ([(0.0, [0, 0])], {}, "its times do not grow"),
        ([(0.1, [])], {}, "a point has no positions"),
        ([(0.1, [float("nan"), 0])], {}, "a point has no positions"),
        ([(0.1, [0, 0])], {"velocities": [0, float("inf")]}, "is infinite"),
        ([(0.1, [0, 0])], {"names": ["lift", "other"]}, "has no joint turn"),
        ([(0.1, [0, 0, 0])], {"names": [*JOINTS, "grip"]}, "moves the joint grip"),
        ([(0.1, [0, 0, 0])], {"names": ["lift", *JOINTS]}, "a joint is twice"),
        ([(0.1, [0, 0, 0])], {}, "too many positions"),
        ([(0.1 * k, [0, 0]) for k in range(1, 6)], {}, "too many points"),
        ([(0.1, [0, 0])], {"stamp": 10**18}, "ago"),
        ([(0.1, [0, 0])], {"stamp": 4 * 10**18}, "later"),
    ],
)
def test_a_goal_that_cannot_be_followed_is_rejected(
    client, told, points, fields, why
) -> None:
    _, accepted = client.send(*points, **fields)
    assert not accepted
    assert why in told[-1]


def test_a_goal_that_cannot_be_judged_is_rejected(arm, client, told) -> None:
    way = 0.1, [0, 0]
    for tolerance in (
        client.tolerance("lift", velocity=0.1),
        client.tolerance("lift", acceleration=0.1),
        client.tolerance("other", position=0.1),
        client.tolerance("lift", position=float("nan")),
    ):
        for field in ("path_tolerance", "goal_tolerance"):
            assert not client.send(way, **{field: tolerance})[1]
    multi = client.types.new("trajectory_msgs/msg/MultiDOFJointTrajectory")
    multi.points = [
        client.types.new("trajectory_msgs/msg/MultiDOFJointTrajectoryPoint")
    ]
    assert not client.send(way, multi_dof_trajectory=multi)[1]
    part = client.types.new("control_msgs/msg/JointComponentTolerance")
    assert not client.send(way, component_path_tolerance=[part])[1]
    goal, accepted = client.send(way)
    assert accepted
    assert not client.send(way, goal_id=goal)[1]
    assert "its identity was used before" in told[-1]
    arm.result(client.result(goal))


def test_a_goal_is_rejected_while_nobody_follows(client, told, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(trajectory_action, "_AWAY", 0.0)  # whatever is there is too old
        assert not client.send((0.1, [0, 0]))[1]
    assert "TRAJ is not written" in told[-1]
    monkeypatch.setattr(trajectory_action, "_AWAY", FAR)
    goal, accepted = client.send((0.1, [0, 0]))
    assert accepted
    waits = client.result(goal)
    monkeypatch.setattr(trajectory_action, "_AWAY", 0.0)
    response = waits.result(FAR)
    assert response.status == Status.ABORTED
    assert "no longer written" in response.result.error_string


def test_a_goal_is_canceled_and_the_arm_stands(arm, client) -> None:
    assert client.cancel().return_code == 1, "there is none"
    goal, _ = client.send((10.0, [9.0, 9.0]))
    waits = client.result(goal)
    arm.until(lambda: arm.bench.outputs.y[0] > 1.001)
    assert client.cancel(client.identity(b"x" * 16)).return_code == 2
    assert client.cancel(stamp_ns=1).return_code == 1, "it is younger"
    answer = client.cancel(goal)
    assert answer.return_code == 0
    assert bytes(answer.goals_canceling[0].goal_id.uuid) == bytes(goal.uuid)
    status, _ = arm.result(waits)
    assert status is Status.CANCELED
    stands = arm.bench.outputs.y.copy()
    arm.step()
    assert (arm.bench.outputs.y == stands).all()
    assert client.cancel(goal).return_code == 3
    seen = [client.got["status"].get(timeout=FAR) for _ in range(3)]
    assert [one.status_list[0].status for one in seen] == [2, 3, 5]


def test_a_cancel_waits_for_no_goal_and_is_sent_once(arm, client) -> None:
    assert len(set(client.queues.values())) == 3
    goal, _ = client.send((10.0, [9.0, 9.0]))
    waits = client.result(goal)
    sent = arm.sent()
    for _ in range(3):
        answer = client.cancel(goal)
        assert answer.return_code == 0
        assert len(answer.goals_canceling) == 1
    assert arm.sent() == sent + 1
    assert arm.result(waits)[0] is Status.CANCELED


def test_the_end_of_another_trajectory_is_not_that_of_the_goal(
    arm, client, monkeypatch
) -> None:
    """As a link that was destroyed and made again counts from 1."""
    monkeypatch.setattr(trajectory_action, "_TAKEN", 0.1)
    goal, _ = client.send((0.1, [1.0, 2.0]))
    waits = client.result(goal)
    arm.until(waits.done, number=arm.sent() + 5)
    assert waits.result().status == Status.ABORTED
    assert "has not read the link" in waits.result().result.error_string


def test_no_goal_begins_once_the_bridge_ends(arm, client, told) -> None:
    goal, _ = client.send((10.0, [9.0, 9.0]))
    waits = client.result(goal)
    sent = arm.sent()
    client.close()
    assert waits.result(FAR).status == Status.ABORTED
    assert not client.send((10.0, [9.0, 9.0]))[1]
    assert "the bridge ends" in told[-1]
    assert arm.sent() == sent + 1, "the record that stops it"
    arm.until(lambda: not arm.bench.outputs.y_dot.any())


def test_a_goal_is_sent_again_as_long_as_it_is_watched(arm, client) -> None:
    """But not before it was taken, so that it never begins late."""
    goal, _ = client.send((10.0, [9.0, 9.0]))
    sent = arm.sent()
    assert client.got["feedback"].get(timeout=FAR)
    assert client.got["feedback"].get(timeout=FAR)
    assert arm.sent() == sent
    waits = client.result(goal)
    arm.until(lambda: arm.sent() > sent + 3)
    assert not waits.done()
    assert client.cancel(goal).return_code == 0
    assert arm.result(waits)[0] is Status.CANCELED
    sent = arm.sent()
    second, _ = client.send((0.1, [1.0, 2.0]))
    assert arm.result(client.result(second))[0] is Status.SUCCEEDED
    assert arm.sent() > sent


def test_a_goal_that_is_rejected_leaves_the_other_as_it_is(arm, client) -> None:
    goal, _ = client.send((0.5, [2.0, 3.0]))
    waits = client.result(goal)
    arm.until(lambda: arm.bench.outputs.y[0] > 1.001)
    assert not client.send((0.2, [7.0, 7.0]), names=["lift", "other"])[1]
    assert not client.send((0.2, [7.0, 7.0]), stamp=10**18)[1]
    assert arm.result(waits)[0] is Status.SUCCEEDED
    assert arm.bench.outputs.y.tolist() == [2.0, 3.0]


def test_one_that_leaves_its_path_is_aborted_and_the_arm_stands(
    arm, client, told
) -> None:
    arm.miss[1] = 0.2
    near = client.tolerance("turn", position=0.1)
    goal, accepted = client.send((10.0, [9.0, 9.0]), path_tolerance=near)
    assert accepted
    status, result = arm.result(client.result(goal))
    assert (status, result.error_code) == (Status.ABORTED, -4)
    assert result.error_string == "turn is 0.2 from the path (tolerance 0.1)"
    assert told[-1].endswith(result.error_string)
    arm.until(lambda: not arm.bench.outputs.y_dot.any())


def test_one_that_does_not_arrive_is_aborted_after_its_time(arm, client) -> None:
    arm.miss[0] = 0.2
    near = client.tolerance("lift", position=0.1)
    patience = client.types.new("builtin_interfaces/msg/Duration")
    goal, _ = client.send((0.05, [1.5, 2.0]), goal_tolerance=near)
    waits = client.result(goal)
    arm.until(lambda: arm.bench.outputs.newest[1] == 0)
    arm.step()
    assert not waits.done(), "it may take as long as it likes"
    arm.miss[0] = 0.05
    assert arm.result(waits)[0] is Status.SUCCEEDED
    arm.miss[0] = 0.2
    patience.nanosec = 50_000_000
    goal, _ = client.send(
        (0.05, [1.0, 2.0]), goal_tolerance=near, goal_time_tolerance=patience
    )
    status, result = arm.result(client.result(goal))
    assert (status, result.error_code) == (Status.ABORTED, -5)
    assert "lift is 0.2 from the goal" in result.error_string


def test_a_new_goal_aborts_the_old_one(arm, client) -> None:
    first, _ = client.send((10.0, [9.0, 9.0]))
    waits = client.result(first)
    arm.until(lambda: arm.bench.outputs.y[0] > 1.001)
    second, accepted = client.send((0.1, [1.0, 2.0]))
    assert accepted
    assert waits.result(FAR).status == Status.ABORTED
    assert waits.result().result.error_string == "a new goal replaced it"
    assert arm.result(client.result(second))[0] is Status.SUCCEEDED


def test_a_task_that_stops_aborts_the_goal(arm, client) -> None:
    goal, _ = client.send((10.0, [9.0, 9.0]))
    waits = client.result(goal)
    arm.until(lambda: arm.bench.outputs.y[0] > 1.001)
    arm.until(waits.done, rests=True)
    assert waits.result().status == Status.ABORTED
    assert "has stopped" in waits.result().result.error_string


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"actual": "Q_ME"}, "there is no variable Q_ME"),
        ({"joints": ["lift"]}, "Q_DES does not fit the action"),
        ({"desired": "TRAJ"}, "TRAJ is no position of joints"),
    ],
)
def test_an_action_whose_variables_do_not_fit_is_refused(change, words) -> None:
    fields = {name: getattr(ABOUT, name) for name in ABOUT.__struct_fields__}
    with pytest.raises(ConfigError, match=words):
        check(Action(**fields | change), {one.name: one for one in VARIABLES}, "here")
