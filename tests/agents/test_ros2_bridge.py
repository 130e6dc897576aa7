"""A subsystem as a node of ROS 2, seen by zenoh-ros2-sdk, which knows no pbonet."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zenoh
from watching import free_port, wait_for

from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.node import rt
from pbonet.ros2.message_types import (
    COMMAND,
    COMMAND_TEXT,
    MessageTypes,
    nanoseconds,
)

sdk = pytest.importorskip("zenoh_ros2_sdk")
from zenoh_ros2_sdk import discovery, entity, keyexpr  # noqa: E402
from zenoh_ros2_sdk.qos import QosDurability, QosProfile  # noqa: E402

DOMAIN = 7
JOINTS = """
    from typing import Annotated as A
    from pbonet import OutVar, Params, PortBasedObject, Vector, param

    class Of(Params):
        value: A[float, param("rad", "the first joint", ge=-4, le=4)] = 1.5
        signs: A[tuple[int, ...], param("none", "a list")] = (1, -1)

    class Joints(PortBasedObject[Of]):
        '''An arm that counts.'''

        q: A[Vector, OutVar("Q_MEZ", "2", "rad", "position", new=True)]
        qd: A[Vector, OutVar("Q^_MEZ", "2", "rad/s", "velocity", new=True)]
        t: A[Vector, OutVar("T_MEZ", "2", "N*m", "torque", new=True)]

        def on(self) -> None:
            self.count = 0

        def cycle(self, dt: float) -> None:
            self.count += 1
            self.q[:] = self.params.value, self.count
            self.qd[:] = self.count
            self.t[:] = -self.count
"""
SVAR = """
NAME Q_MEZ
TYPE double
DESC position
UNITS rad
NELEM 2

NAME Q^_MEZ
TYPE double
DESC velocity
UNITS rad/s
NELEM 2

NAME T_MEZ
TYPE double
DESC torque
UNITS N*m
NELEM 2

NAME SPEED
TYPE double
DESC what a node of ROS wants
UNITS m/s
NELEM 2
MAXAGE 0.5

NAME NDOF
TYPE int
DESC joints
UNITS none
NELEM 1
INIT 2

NAME Q_DES
TYPE double
DESC where the trajectory is
UNITS rad
NELEM 2

NAME Q^_DES
TYPE double
DESC its speed
UNITS rad/s
NELEM 2

NAME TRAJ
TYPE double
DESC the newest trajectory
UNITS mixed
NELEM 2
EOF
"""
RMOD = """MODULE {module}
DESC a test
{alias}
INCONST {constant}
OUTCONST none
INVAR none
OUTVAR {out}
TASKTYPE periodic
FREQ {hz}
{local}
EOF
"""
OUT = "Q_MEZ Q^_MEZ T_MEZ"
TOPICS = f"""
domain = {DOMAIN}
node = "/lab/arm"
messages = ["interfaces"]

[[publish]]
topic = "/joint_states"
type = "sensor_msgs/msg/JointState"
frame = "base"
fields = {{ position = "Q_MEZ", velocity = "Q^_MEZ", effort = "T_MEZ" }}
constants = {{ name = ["one", "two"] }}

[[publish]]
topic = "torque"
type = "my_msgs/msg/Torque"
fields = {{ "axis.y" = "T_MEZ[1]" }}
max_hz = 50

[[subscribe]]
topic = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
link = "cmd_vel"
fields = ["linear.x", "angular.z"]

[[action]]
name = "/arm_controller/follow_joint_trajectory"
link = "way"
joints = ["one", "two"]
desired = "Q_DES"
actual = "Q_DES"
"""
FOLLOW = "control_msgs/action/FollowJointTrajectory"
FOLLOW_HASHES = {  # as rosidl generates them
    "SendGoal": "b13789dddc325a7a962825c45e28c77d37237ec129dd0c34dc5994562938c57f",
    "GetResult": "e3ceb38e3e1867c8dc0f46014df26e90eb93422f27e9e97f936e07f94be4bc8b",
    "FeedbackMessage": "80398fcb9674a79081a9906e2ccf0c80"
    "4dd7cb15e22e362e606ee87186beab71",
}
BREAK = "=" * 80 + "\nMSG: "
TOLERANCE = "float64 position\nfloat64 velocity\nfloat64 acceleration\n"
UUID = "unique_identifier_msgs/UUID goal_id\n"
SEND_GOAL = f"""unique_identifier_msgs/UUID goal_id
control_msgs/Goal goal
{BREAK}control_msgs/Goal
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
control_msgs/JointTolerance[] path_tolerance
control_msgs/JointComponentTolerance[] component_path_tolerance
control_msgs/JointTolerance[] goal_tolerance
control_msgs/JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
{BREAK}control_msgs/JointTolerance
string name
{TOLERANCE}{BREAK}control_msgs/JointComponentTolerance
string joint_name
uint16 component
{TOLERANCE}"""
GET_RESULT = f"""int8 status
control_msgs/Result result
{BREAK}control_msgs/Result
int32 error_code
string error_string
"""
FEEDBACK = """unique_identifier_msgs/UUID goal_id
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
"""
GET = "string[] names", "rcl_interfaces/ParameterValue[] values"
SET = (
    "rcl_interfaces/Parameter[] parameters",
    "rcl_interfaces/SetParametersResult[] results",
)
TORQUE = "geometry_msgs/Vector3 axis\nstring why\n"


def text_of(name):
    """Return the text of a message and write what it needs beside it, for the SDK."""
    return MessageTypes().definition(name).partition("=" * 80)[0]


@pytest.fixture
def messages(tmp_path):
    """Definitions that the SDK gets as text, as it can download none here."""
    for name in (
        "std_msgs/msg/Header",
        "builtin_interfaces/msg/Time",
        "sensor_msgs/msg/JointState",
        "geometry_msgs/msg/Vector3",
        "geometry_msgs/msg/Twist",
        "rcl_interfaces/msg/Log",
        "rcl_interfaces/msg/ParameterValue",
        "rcl_interfaces/msg/Parameter",
        "rcl_interfaces/msg/SetParametersResult",
    ):
        file = tmp_path / "texts" / f"{name}.msg"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text_of(name))
    own = tmp_path / "interfaces" / "my_msgs" / "msg"
    own.mkdir(parents=True)
    (own / "Torque.msg").write_text(TORQUE)
    return tmp_path / "texts"


@pytest.fixture
def arm(nodes, tmp_path):
    """A subsystem with two tasks that are ON, and one to swap to."""
    nodes.write_module("joints", JOINTS)
    receive = "LOCAL\nLINK ros2:cmd_vel"
    counts = RMOD.format(
        module="joints", alias="", constant="none", out=OUT, hz=500, local=""
    )
    for name, text in (
        ("a.svar", SVAR),
        ("a.sbs", "SUBSYSTEM arm\nSVARFILE a.svar\nRTPU arm0\nEOF\n"),
        ("one.rmod", counts),
        ("two.rmod", counts),
        (
            "seen.rmod",
            RMOD.format(
                module="tbuf_receive",
                alias="SVARALIAS Z=SPEED",
                constant="none",
                out="Z",
                hz=200,
                local=receive,
            ),
        ),
        (
            "follow.rmod",
            RMOD.format(
                module="ros_trajectory",
                alias="SVARALIAS Y=Q_DES\nSVARALIAS Y^=Q^_DES",
                constant="NDOF",
                out="Y Y^ TRAJ",
                hz=200,
                local="LOCAL\nLINK ros2:way",
            ),
        ),
        ("a.toml", TOPICS),
    ):
        (tmp_path / name).write_text(text)
    nodes.agent("arm0")
    with Subsystem(tmp_path / "a.sbs", domain=nodes.domain, record="off") as arm:
        arm.spawn("one")
        arm.spawn("seen")
        arm.spawn("follow")
        arm.on(["one", "seen", "follow"])
        arm.detach()
        yield tmp_path, nodes.domain
        arm.open()


@pytest.fixture
def bridge(arm, messages):  # noqa: ARG001 - its file names their folder
    """The process, the port of its router, and what it says."""
    folder, domain = arm
    port = free_port()
    words = ["ros2", "bridge", folder / "a.sbs", "--topics", folder / "a.toml"]
    words += ["--listen", f"tcp/127.0.0.1:{port}", "--control", "--json"]
    with (
        (folder / "errors").open("w") as errors,
        subprocess.Popen(
            [sys.executable, "-m", "pbonet.cli", *map(str, words), "--domain", domain],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process,
    ):
        try:
            told = process.stdout.readline()
            assert told, (folder / "errors").read_text()
            yield process, port, json.loads(told)
        finally:
            killed = process.poll() == -signal.SIGKILL
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
    assert killed or process.returncode == 0


@pytest.fixture
def node(bridge, messages, monkeypatch):
    """The SDK's own session with our router."""
    _, port, _ = bridge
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", "scouting/multicast/enabled=false")
    monkeypatch.setenv("GIT_ALLOW_PROTOCOL", "none")  # it would fetch definitions
    sdk.get_registry().messages_dir = messages
    session = sdk.ZenohSession.get_instance("127.0.0.1", port)
    yield session
    session.session.close()
    sdk.ZenohSession._instance = None


def told(folder, words):
    """Wait until the bridge has told something."""
    wait_for(lambda: words in (folder / "errors").read_text(), words)


def our_tokens(node):
    """Return what the SDK finds of us in the graph."""
    return {str(r.ok.key_expr) for r in node.liveliness.get(f"@ros2_lv/{DOMAIN}/**")}


def token(node, number, kind, name, made):
    """Return the token of our end that fits one of the SDK, as it would write it."""
    ours = next(t for t in our_tokens(node) if t.endswith("/NN/%/%lab/arm"))
    of = entity.NodeEntity(DOMAIN, ours.split("/")[2], 0, "arm", "/lab")
    qos = "1:2:1,10:,:,:,,"
    assert QosProfile.decode(qos) == QosProfile()
    end = entity.EndpointEntity(
        of, number, kind, name, made.dds_type_name, made.type_hash, qos
    )
    return keyexpr.endpoint_liveliness_keyexpr(end)


def test_a_node_of_ros_sees_moves_and_commands_a_subsystem(arm, bridge, node) -> None:
    is_soon_awake(bridge[0].pid)
    sees_it(node, bridge[2])
    gets_its_variables()
    commands_it()
    moves_it(arm, node)
    follows(arm, node)
    says_why()
    disturbs_it(arm, node)


def test_an_arm_stops_when_its_bridge_is_killed_amid_a_goal(arm, bridge, node) -> None:
    """Nobody could cancel the goal, or see that it leaves its path."""
    (folder, domain), process = arm, bridge[0]
    with (
        contextlib.ExitStack() as ends,
        Subsystem(folder / "a.sbs", domain=domain, watch=True) as watching,
    ):
        goals, _ = clients_of_the_action(ends)
        made = node.store.types
        goal_id = made["unique_identifier_msgs/msg/UUID"](np.arange(16, dtype="u1"))
        goal = goal_for(made, MessageTypes(), ["one", "two"], seconds=600)
        assert goals.call(goal_id=goal_id, goal=goal).accepted

        def shown(name):
            return list(watching.display([name])[0].values)

        wait_for(lambda: shown("TRAJ")[1] < 599.0, "it goes on while it is watched")
        assert 0.0 < shown("Q_DES")[0] < 1.0
        process.kill()
        wait_for(lambda: shown("TRAJ")[1] == -1.0, "the stop")
        assert shown("Q^_DES") == [0.0, 0.0]
        stands = shown("Q_DES")
        before = watching.status("follow").cycle
        wait_for(lambda: watching.status("follow").cycle > before + 10, "its cycles")
        assert shown("Q_DES") == stands
        said = [one.text for one in watching.events(task="follow")]
        assert [text for text in said if "is silent for" in text]


def is_soon_awake(pid):
    """The main thread and those of zenoh have short slices."""
    slices = {}
    for path in Path(f"/proc/{pid}/task").glob("*/sched"):
        if found := re.search(r"^se\.slice +: +(\d+)", path.read_text(), re.MULTILINE):
            name = (path.parent / "comm").read_text().strip()
            slices[name, path.parent.name == str(pid)] = int(found[1])
    if slices and rt.probe().fifo:  # this kernel tells, and tasks come first
        ours = {name: ns for name, ns in slices.items() if name[1] or "-" in name[0]}
        assert set(ours.values()) == {100_000}, slices
        assert {name.partition("-")[0] for name, _ in ours} >= {"rx", "tx", "net"}


def sees_it(node, about):
    """The SDK lists our ends, which are as it would have put them into the graph."""
    assert about["publishes"] == ["/rosout", "/joint_states", "/lab/arm/torque"]
    assert {"/lab/arm/swap", "/lab/arm/set_parameters"} <= set(about["services"])
    assert about["actions"] == ["/arm_controller/follow_joint_trajectory"]
    topics = dict(discovery.get_topic_names_and_types(DOMAIN))
    assert topics["/joint_states"] == ["sensor_msgs/msg/JointState"]
    assert topics["/cmd_vel"] == ["geometry_msgs/msg/Twist"]
    services = dict(discovery.get_service_names_and_types(DOMAIN))
    assert services["/lab/arm/swap"] == [COMMAND]
    publisher = sdk.ROS2Publisher(
        "/cmd_vel", "geometry_msgs/msg/Twist", domain_id=DOMAIN, namespace="/sdk"
    )
    states = sdk.ROS2Subscriber(
        "/joint_states", "sensor_msgs/msg/JointState", print, domain_id=DOMAIN
    )
    swap = sdk.ROS2ServiceClient(
        "/lab/arm/swap", COMMAND, *COMMAND_TEXT.split("---\n"), domain_id=DOMAIN
    )
    seen = our_tokens(node)
    for number, kind, end, name in (
        (2, entity.EntityKind.SUBSCRIPTION, publisher, "/cmd_vel"),
        (3, entity.EntityKind.PUBLISHER, states, "/joint_states"),
        (
            about["services"].index("/lab/arm/swap") + 10,
            entity.EntityKind.SERVICE,
            swap,
            "/lab/arm/swap",
        ),
    ):
        wanted = token(node, number, kind, name, end)
        assert wanted in seen
    for end in (publisher, states, swap):
        end.close()


def gets_its_variables():
    """One JointState of three variables for each of 500 commits a second."""
    got, torques = [], []
    with contextlib.ExitStack() as ends:
        for topic, name, text, take in (
            ("/joint_states", "sensor_msgs/msg/JointState", None, got.append),
            ("/lab/arm/torque", "my_msgs/msg/Torque", TORQUE, torques.append),
        ):
            end = sdk.ROS2Subscriber(
                topic, name, take, msg_definition=text, domain_id=DOMAIN
            )
            ends.callback(end.close)
        wait_for(lambda: len(got) > 1000 and torques, "messages")
        got = list(got)  # more may come
        end_ns = time.time_ns()
    first, last = got[0], got[-1]
    assert (first.name, first.header.frame_id) == (["one", "two"], "base")
    for one in got:  # one commit, whole
        count = one.position[1]
        assert one.position.tolist() == [1.5, count]
        assert one.velocity.tolist() == [count] * 2
        assert one.effort.tolist() == [-count] * 2
    steps = np.diff([one.position[1] for one in got])
    assert (steps >= 1).all(), "in order, and each once"
    assert (steps == 1).any(), "each commit, as far as the machine can"
    stamps = [nanoseconds(m.header.stamp) for m in (first, last)]
    assert stamps[0] < stamps[1] < end_ns
    assert torques[0].axis.y < 0 == torques[0].axis.x
    assert torques[0].why == ""


def service(name, kind, *texts):
    """Return a client of the SDK."""
    return sdk.ROS2ServiceClient(
        f"/lab/arm/{name}", kind, *texts, domain_id=DOMAIN, timeout=60.0
    )


def commands_it():
    """Services are commands of the one table, and the parameters of tasks."""
    with contextlib.ExitStack() as ends:

        def call(name, arguments):
            one = service(name, COMMAND, *COMMAND_TEXT.split("---\n"))
            ends.callback(one.close)
            return one.call(arguments=arguments)

        done = call("swap", "one two")
        assert done.success, done.message
        states = {
            one["task"]: one["fields"]["state"]
            for one in json.loads(call("status", "").data)["tasks"]
        }
        assert states == {"one": "OFF", "two": "ON", "seen": "ON", "follow": "ON"}
        refused = call("on", "nobody")
        assert not refused.success
        assert "the subsystem has no task nobody" in refused.message
        for name in ("ParameterValue", "Parameter", "SetParametersResult"):
            sdk.load_message_type(f"rcl_interfaces/msg/{name}")
        get = service("get_parameters", "rcl_interfaces/srv/GetParameters", *GET)
        change = service("set_parameters", "rcl_interfaces/srv/SetParameters", *SET)
        ends.callback(get.close)
        ends.callback(change.close)
        names = ["two.value", "two.signs", "two.nothing"]
        values = get.call(names=names).values
        assert [one.type for one in values] == [3, 7, 0]
        assert values[1].integer_array_value.tolist() == [1, -1]
        values[0].double_value = -2.5
        results = [set_one(change, "two.value", values[0])]
        values[0].double_value = 99.0
        results.append(set_one(change, "two.value", values[0]))
        assert [one.successful for one in results] == [True, False]
        assert "99" in results[1].reason
        assert get.call(names=names).values[0].double_value == -2.5


def set_one(client, name, value):
    """Set one parameter by a client of the SDK; return its result."""
    kind = client.session_mgr.store.types["rcl_interfaces/msg/Parameter"]
    return client.call(parameters=[kind(name=name, value=value)]).results[0]


def speed(arm):
    """Return what the table has of the speed that ROS wants."""
    folder, domain = arm
    with Subsystem(folder / "a.sbs", domain=domain, watch=True) as watching:
        return watching.display(["SPEED"])[0]


def moves_it(arm, node):
    """A topic is a link: it has an age, and gets stale when its node is silent."""
    assert speed(arm).stale, "nothing came yet"
    twist, vector = (
        node.register_message_type(None, f"geometry_msgs/msg/{name}")
        for name in ("Twist", "Vector3")
    )
    wheel = sdk.ROS2Publisher("/cmd_vel", "geometry_msgs/msg/Twist", domain_id=DOMAIN)

    def arrived():
        wheel.publish(linear=vector(x=0.5, y=9, z=9), angular=vector(x=9, y=9, z=-0.25))
        one = speed(arm)
        return not one.stale and list(one.values) == [0.5, -0.25]

    wait_for(arrived, "the speed")
    assert twist.__msgtype__ == "geometry_msgs/msg/Twist"
    wheel.close()
    wait_for(lambda: speed(arm).stale, "a silent node")
    assert list(speed(arm).values) == [0.5, -0.25]


def follows(arm, node):
    """A goal of an action is followed, with feedback and a result, or rejected."""
    types, got = MessageTypes(), []
    with contextlib.ExitStack() as ends:
        goals, results = clients_of_the_action(ends)
        feedback = sdk.ROS2Subscriber(
            "/arm_controller/follow_joint_trajectory/_action/feedback",
            f"{FOLLOW}_FeedbackMessage",
            got.append,
            msg_definition=FEEDBACK + texts_of_trajectories(),
            domain_id=DOMAIN,
            type_hash=f"RIHS01_{FOLLOW_HASHES['FeedbackMessage']}",
        )
        ends.callback(feedback.close)
        made = node.store.types
        goal_id = made["unique_identifier_msgs/msg/UUID"](np.arange(16, dtype="u1"))
        for names, takes in ((["one", "three"], False), (["two", "one"], True)):
            goal = goal_for(made, types, names)
            assert goals.call(goal_id=goal_id, goal=goal).accepted is takes
        told(arm[0], "the message has no joint two")
        done = results.call(goal_id=goal_id)
        assert (done.status, done.result.error_code) == (4, 0), done.result.error_string
        wait_for(lambda: got, "feedback")
        assert got[0].joint_names == ["one", "two"]
        assert got[0].goal_id.uuid.tolist() == list(range(16))
    with Subsystem(arm[0] / "a.sbs", domain=arm[1], watch=True) as watching:
        assert list(watching.display(["Q_DES"])[0].values) == [0.5, 1.0]


def says_why():
    """A goal's rejection has no text; the reason is in the log of the node."""
    got = []
    qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL)
    log = sdk.ROS2Subscriber(
        "/rosout", "rcl_interfaces/msg/Log", got.append, domain_id=DOMAIN, qos=qos
    )
    why = "the message has no joint two (expected one two, got one three)"
    wait_for(lambda: [one for one in got if why in one.msg], "the reason")
    log.close()
    (one,) = [one for one in got if why in one.msg]
    assert (one.name, one.level) == ("lab.arm", 30)
    assert one.msg.startswith("/arm_controller/follow_joint_trajectory: ")
    assert one.stamp.sec > 0


def texts_of_trajectories():
    """Return the definitions that the action's own need."""
    types = MessageTypes()
    return "".join(
        f"{BREAK}{name.replace('/msg/', '/')}\n{types.definition(name)}"
        for name in (
            "unique_identifier_msgs/msg/UUID",
            "trajectory_msgs/msg/JointTrajectory",
            "trajectory_msgs/msg/MultiDOFJointTrajectory",
        )
    )


def clients_of_the_action(ends):
    """Return the SDK's clients that send a goal, and that ask for its result."""
    accepted = "bool accepted\nbuiltin_interfaces/Time stamp\n"
    made = [
        sdk.ROS2ServiceClient(
            f"/arm_controller/follow_joint_trajectory/_action/{name}",
            f"{FOLLOW}_{part}",
            ask + texts_of_trajectories(),
            answer,
            domain_id=DOMAIN,
            type_hash=f"RIHS01_{FOLLOW_HASHES[part]}",
            timeout=60.0,
        )
        for name, part, ask, answer in (
            ("send_goal", "SendGoal", SEND_GOAL, accepted),
            ("get_result", "GetResult", UUID, GET_RESULT),
        )
    ]
    for end in made:
        ends.callback(end.close)
    return made


def goal_for(made, types, names, seconds=0):
    """Return a goal with one point, made of the SDK's own types."""

    def theirs(ours):
        """Return one of our messages as the SDK's."""
        fields = {
            key: theirs(value) if hasattr(value, "__msgtype__") else value
            for key, value in vars(ours).items()
        }
        return made[ours.__msgtype__](**fields)

    way = theirs(types.new("trajectory_msgs/msg/JointTrajectory"))
    point = theirs(types.new("trajectory_msgs/msg/JointTrajectoryPoint"))
    point.time_from_start.sec = seconds
    point.time_from_start.nanosec = 400_000_000
    point.positions = np.array([1.0, 0.5])
    way.joint_names, way.points = names, [point]
    several = types.new("trajectory_msgs/msg/MultiDOFJointTrajectory")
    return made["control_msgs/msg/Goal"](
        trajectory=way,
        multi_dof_trajectory=theirs(several),
        path_tolerance=[],
        component_path_tolerance=[],
        goal_tolerance=[],
        component_goal_tolerance=[],
        goal_time_tolerance=theirs(types.new("builtin_interfaces/msg/Duration")),
    )


def disturbs_it(arm, node):
    """Whatever others send is told, and neither ends nor stops anything."""
    folder, _ = arm
    types = MessageTypes()
    name = "geometry_msgs/msg/Twist"
    key = f"{DOMAIN}/cmd_vel/geometry_msgs::msg::dds_::Twist_/{types.hash(name)}"
    good = types.encode(name, types.new(name))
    number = iter(range(1, 1 << 30))

    def put(data, block=True):
        attachment = next(number).to_bytes(8, "little") + bytes(8) + b"\x10" + bytes(16)
        control = (
            zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP
        )
        node.session.put(key, data, attachment=attachment, congestion_control=control)

    put(bytes(10 << 20))
    told(folder, "a message is too long, and was not read (expected at most 1048576")
    put(b"\0\1\0\0too short")
    told(folder, "this is no message geometry_msgs/msg/Twist")
    node.session.put(key, good, attachment=b"abc")
    told(folder, "this is no attachment of rmw_zenoh")
    other = sdk.ROS2Publisher(
        "/cmd_vel", name, domain_id=DOMAIN, type_hash="RIHS01_" + 64 * "0"
    )
    told(folder, "means another definition")
    other.close()
    another = sdk.ROS2Publisher(
        "/cmd_vel", "my_msgs/msg/Torque", msg_definition=TORQUE, domain_id=DOMAIN
    )
    told(folder, "means my_msgs/msg/Torque")
    another.close()
    # A subscriber that never reads: its queue is full at once.
    held = node.session.declare_subscriber(
        f"{DOMAIN}/joint_states/**", zenoh.handlers.FifoChannel(1)
    )
    for _ in range(20_000):
        put(good, block=False)
    told(folder, "messages come faster than max_hz = 1000")
    with Subsystem(folder / "a.sbs", domain=arm[1], watch=True) as watching:

        def is_new():
            put(good, block=False)
            return not watching.display(["SPEED"])[0].stale

        wait_for(is_new, "the newest message")
        before = watching.status("two").cycle
        wait_for(lambda: watching.status("two").cycle > before + 100, "its cycles")
    del held
