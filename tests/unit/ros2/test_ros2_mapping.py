"""Variables as messages, and messages as records; CDR is read by mcap-ros2-support."""

from __future__ import annotations

import contextlib
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest

from pbonet import tbuf, xm
from pbonet.config.model import Variable
from pbonet.errors import ConfigError, ProtocolError, XmTakenError
from pbonet.ros2._numbers import Filler, Taker
from pbonet.ros2.field_paths import Slice
from pbonet.ros2.message_types import MessageTypes, dtype_of, nanoseconds, set_stamp
from pbonet.ros2.publishing import Filling
from pbonet.ros2.repeated_warnings import Warnings
from pbonet.ros2.subscribing import Incoming, reading
from pbonet.ros2.topics_file import Publish, Subscribe, by_names, read_topics
from pbonet.ros2.wire_format import LONGEST, Attachment
from pbonet.svar import now_ns

pytest.importorskip("rosbags")
STAMP = 1_700_000_000_123_456_789
JOINTS = "sensor_msgs/msg/JointState"
VARIABLES = {
    one.name: one
    for one in (
        Variable(name="Q_MEZ", type="double", nelem=3, units="rad"),
        Variable(name="Q^_MEZ", type="double", nelem=3, units="rad/s"),
        Variable(name="T_MEZ", type="float", nelem=3, units="N*m"),
        Variable(name="DEG", type="double", nelem=3, units="deg"),
        Variable(name="X", type="double", nelem=7, units="any"),
        Variable(name="V", type="double", nelem=6, units="m/s"),
        Variable(name="ON", type="bool", nelem=1),
        Variable(name="COUNT", type="int", nelem=2),
        Variable(name="RAW", type="struct[5]"),
    )
}


@pytest.fixture(scope="module")
def types():
    return MessageTypes()


@pytest.fixture(autouse=True)
def home():
    xm.live_on("ros2", domain="d")
    yield
    xm.live_on("local")


def decoded(types, name, data):
    """Return a message as an implementation that is not rosbags reads it."""
    dynamic = pytest.importorskip("mcap_ros2._dynamic")
    return dynamic.generate_dynamic(name, types.definition(name))[name](data)


def filled(types, name, fields, **more):
    """Return a message that is filled with 1, 2, ... of each variable."""
    about = Publish(topic="t", type=name, fields=fields, **more)
    filling = Filling(types, about, VARIABLES, "here")
    values = {
        one: (np.arange(VARIABLES[one].nelem) + 1).astype(VARIABLES[one].dtype)
        for one in filling.variables
    }
    return decoded(types, name, filling.of(values).encode(STAMP))


def plain(*vectors):
    """Return the numbers of small messages."""
    return [[getattr(one, key) for key in one.__slots__] for one in vectors]


def test_three_variables_are_one_joint_state(types) -> None:
    fields = {"position": "Q_MEZ", "velocity": "Q^_MEZ", "effort": "T_MEZ"}
    got = filled(
        types, JOINTS, fields, frame="base", constants={"name": ["a", "b", "c"]}
    )
    assert got.name == ["a", "b", "c"]
    assert list(got.position) == list(got.velocity) == list(got.effort) == [1, 2, 3]
    assert (got.header.frame_id, got.header.stamp.sec) == ("base", STAMP // 10**9)
    assert got.header.stamp.nanosec == STAMP % 10**9


@pytest.mark.parametrize(
    ("name", "fields", "where", "expected"),
    [
        ("geometry_msgs/msg/Twist", {"linear": "V[0:3]"}, "linear", [1, 2, 3]),
        (
            "geometry_msgs/msg/TwistStamped",
            {"twist.linear": "V[3:6]"},
            "twist.linear",
            [4, 5, 6],
        ),
        (
            "geometry_msgs/msg/PoseStamped",
            {"pose.orientation": "X[3:7]"},
            "pose.orientation",
            [4, 5, 6, 7],
        ),
        (
            "geometry_msgs/msg/WrenchStamped",
            {"wrench.torque": "T_MEZ"},
            "wrench.torque",
            [1, 2, 3],
        ),
        (
            "sensor_msgs/msg/Imu",
            {"angular_velocity": "Q^_MEZ"},
            "angular_velocity",
            [1, 2, 3],
        ),
        (
            "nav_msgs/msg/Odometry",
            {"pose.pose": "X"},
            "pose.pose.orientation",
            [4, 5, 6, 7],
        ),
        (
            "tf2_msgs/msg/TFMessage",
            {"transforms[1].transform.translation": "X[0:3]"},
            "transforms.1.transform.translation",
            [1, 2, 3],
        ),
    ],
)
def test_parts_of_variables_are_parts_of_messages(
    types, name, fields, where, expected
) -> None:
    found = filled(types, name, fields)
    for part in where.split("."):
        found = found[int(part)] if part.isdigit() else getattr(found, part)
    assert plain(found) == [expected]


def test_single_numbers_truths_and_lists(types) -> None:
    assert filled(types, "std_msgs/msg/Bool", {"data": "ON"}).data is True
    assert filled(types, "std_msgs/msg/Int32", {"data": "COUNT[1]"}).data == 2
    battery = filled(
        types,
        "sensor_msgs/msg/BatteryState",
        {"voltage": "X[0]", "cell_voltage": "X"},
        constants={"present": True, "serial_number": "7", "power_supply_status": 2},
    )
    assert (battery.voltage, list(battery.cell_voltage)) == (1.0, [1, 2, 3, 4, 5, 6, 7])
    assert (battery.present, battery.serial_number) == (True, "7")
    assert battery.power_supply_status == 2
    path = "trajectory_msgs/msg/JointTrajectory"
    line = filled(types, path, {"points[0].positions": "Q_MEZ"})
    assert list(line.points[0].positions) == [1, 2, 3]


def test_several_variables_are_one_list(types) -> None:
    parts = {"position[0:3]": "Q_MEZ", "position[5]": "V[5]", "position[3:5]": "X[0:2]"}
    variables = {"V": Variable(name="V", type="double", nelem=6, units="rad")}
    variables["X"] = Variable(name="X", type="double", nelem=7, units="rad")
    about = Publish(topic="t", type=JOINTS, fields=parts)
    filling = Filling(types, about, VARIABLES | variables, "here")
    values = {"Q_MEZ": np.array([1.0, 2, 3]), "X": np.arange(7) + 4.0, "V": np.ones(6)}
    got = decoded(types, JOINTS, filling.of(values).encode(STAMP))
    assert list(got.position) == [1, 2, 3, 4, 5, 1]


def test_some_elements_of_an_array_and_constants_beside_them(types) -> None:
    got = filled(
        types,
        "sensor_msgs/msg/Imu",
        {"angular_velocity_covariance[4]": "X[6]"},
        constants={"orientation_covariance": [-1.0, *[0.0] * 8]},
    )
    assert list(got.angular_velocity_covariance) == [0] * 4 + [7] + [0] * 4
    assert list(got.orientation_covariance) == [-1] + [0] * 8


@pytest.mark.parametrize(
    ("fields", "constants", "said"),
    [
        ({"position": "Q_MEZ", "position[0:2]": "Q_MEZ[0:2]"}, {}, "is given twice"),
        ({"position[0:2]": "Q_MEZ[0:2]", "position[1]": "Q_MEZ[0]"}, {}, "given twice"),
        ({"position": "Q_MEZ"}, {"position": [1.0, 2.0]}, "position is given twice"),
        ({"header.stamp": "X[0:2]", "header.stamp.sec": "X[2]"}, {}, "given twice"),
        ({"header.stamp.sec": "X[0]"}, {}, "stamp of a header.*got header.stamp.sec"),
        ({"position[1:3]": "Q_MEZ[0:2]"}, {}, r"nothing gives position\[0:1\]"),
        ({"position[0:3]": "X"}, {}, "X does not fit.*expected 3 elements, got 7"),
    ],
)
def test_each_number_of_a_message_is_given_once(types, fields, constants, said) -> None:
    variables = VARIABLES | {"X": Variable(name="X", type="double", nelem=7)}
    about = Publish(topic="t", type=JOINTS, fields=fields, constants=constants)
    with pytest.raises(ConfigError, match=said):
        Filling(types, about, variables, "here")


@pytest.mark.parametrize(
    ("name", "path", "said"),
    [
        ("sensor_msgs/msg/Imu", "orientation_covariance[8:10]", "elements 0 to 8"),
        ("geometry_msgs/msg/Twist", "linear.x[0]", "which is no list"),
        ("tf2_msgs/msg/TFMessage", "transforms[0:2].transform", "a list of messages"),
        (JOINTS, "position[3:3]", "elements 0 to 999"),
    ],
)
def test_elements_that_a_message_cannot_have_are_told(types, name, path, said) -> None:
    """Both ways: a topic that is subscribed would never get one."""
    with pytest.raises(ConfigError, match=said):
        filled(types, name, {path: "X"})
    with pytest.raises(ConfigError, match=said):
        reading(types, Subscribe(topic="t", type=name, link="x", fields=[path]), "here")


@pytest.mark.parametrize(
    ("name", "fields", "said"),
    [
        (JOINTS, {"position": "DEG"}, r"DEG does not fit position \(expected rad or m"),
        (JOINTS, {"position": "Q_MEX"}, "no variable Q_MEX.*Q_MEZ"),
        (JOINTS, {"position": "Q_MEZ[2:5]"}, "are no elements of Q_MEZ"),
        (JOINTS, {"positions": "Q_MEZ"}, "has no field positions.*position"),
        (JOINTS, {"name": "Q_MEZ"}, "name is not a number"),
        (JOINTS, {"header": "X"}, "frame_id is not a number"),
        (JOINTS, {"position": "RAW"}, "RAW is a struct"),
        (JOINTS, {}, "no variable is published"),
        (JOINTS, {"effort": "T_MEZ[0:2]", "position": "Q_MEZ"}, "lists differ in size"),
        ("sensor_msgs/msg/JointStat", {"a": "X"}, "no message.*JointState"),
        ("geometry_msgs/msg/Twist", {"linear": "V"}, r"expected 3 elements, got 6"),
        ("geometry_msgs/msg/Twist", {"linear.x.y": "V[0]"}, "has no field y"),
        ("tf2_msgs/msg/TFMessage", {"transforms.transform": "X"}, "a list of messages"),
    ],
)
def test_what_does_not_fit_is_told(types, name, fields, said) -> None:
    with pytest.raises(ConfigError, match=said):
        filled(types, name, fields)


@pytest.mark.parametrize(
    ("name", "variable", "fits", "not_fitting"),
    [
        ("UInt8", "COUNT[0]", [0, 255], [256, 300, -1]),
        ("Int64", "X[0]", [-(2.0**63), 7.9], [2.0**63, np.nan, np.inf]),
        ("Float32", "X[0]", [3e38, np.nan, np.inf], [1e300, -1e300]),
        ("Bool", "COUNT[0]", [0, 300], []),
        ("UInt8MultiArray", "COUNT", [3], [-3]),
        ("Float32MultiArray", "T_MEZ", [3, np.inf], []),
    ],
)
def test_a_number_that_does_not_fit_is_not_sent(
    types, name, variable, fits, not_fitting
) -> None:
    """It would be another number: 300 is 44 in a uint8."""
    about = Publish(topic="t", type=f"std_msgs/msg/{name}", fields={"data": variable})
    filling = Filling(types, about, VARIABLES, "here")
    one = VARIABLES[variable.partition("[")[0]]
    for number in (*fits, *not_fitting):
        values = {one.name: np.full(one.nelem, number, one.dtype)}
        if number in not_fitting:
            with pytest.raises(ProtocolError, match=r"does not fit data.*expected"):
                filling.of(values).encode(STAMP)
            continue
        data = decoded(types, about.type, filling.of(values).encode(STAMP)).data
        got = data if np.isscalar(data) and not isinstance(data, bytes) else data[0]
        np.testing.assert_allclose(got, bool(number) if name == "Bool" else number, 0.2)


def test_a_constant_does_not_move_the_stamp(types) -> None:
    """Places are found by bytes that differ from these, of which 17 is one."""
    name, about = "geometry_msgs/msg/Vector3Stamped", {"header.stamp.sec": 17}
    got = filled(types, name, {"vector": "Q_MEZ"}, constants=about, frame="base")
    assert (got.header.frame_id, got.header.stamp.sec) == ("base", STAMP // 10**9)


@pytest.mark.parametrize("constants", [{"name": 3}, {"nothing": 1}, {"name": [1]}])
def test_constants_must_fit(types, constants) -> None:
    with pytest.raises(ConfigError, match="the constant"):
        filled(types, JOINTS, {"position": "Q_MEZ"}, constants=constants)


# -- the other way --------------------------------------------------------------------


def record(types, message, name, **about):
    """Return what a message becomes."""
    made = reading(types, Subscribe(topic="t", type=name, link="x", **about), "here")
    found = np.full((), 99.0, made.form)
    made.read(types.decode(name, types.encode(name, message)), found)
    return found


def joint_state(types, names, **columns):
    message = types.new(JOINTS)
    message.name = names
    for key, values in columns.items():
        setattr(message, key, np.array(values, float))
    return message


def test_numbers_of_a_message_in_the_order_that_is_wanted(types) -> None:
    name = "geometry_msgs/msg/Twist"
    message = types.new(name)
    message.linear.x, message.angular.z = 1.5, -2.0
    fields = ["angular.z", "linear"]
    assert record(types, message, name, fields=fields).tolist() == [-2.0, 1.5, 0, 0]


def test_joints_come_in_our_order(types) -> None:
    message = joint_state(
        types, ["c", "x", "a"], position=[3, 9, 1], velocity=[6, 9, 4]
    )
    about = {"fields": ["position", "velocity"], "joints": ["a", "c"]}
    assert record(types, message, JOINTS, **about).tolist() == [1, 3, 4, 6]
    message.velocity = message.velocity[:1]
    with pytest.raises(ProtocolError, match="velocity has too few elements"):
        record(types, message, JOINTS, **about)
    message.name = ["c", "x", "y"]
    with pytest.raises(ProtocolError, match="no joint a"):
        record(types, message, JOINTS, **about)


def test_elements_by_their_number(types) -> None:
    message = joint_state(types, [], position=[1, 2, 3])
    assert record(types, message, JOINTS, fields=["position[1:3]"]).tolist() == [2, 3]
    with pytest.raises(ProtocolError, match=r"expected 5, got 3"):
        record(types, message, JOINTS, fields=["position[0:5]"])


def numbered(types, name, message, first):
    """Give each number of a message another value; return the next one."""
    for field in types.fields(name):
        value = getattr(message, field.name)
        if field.nested:
            for one in [value] if field.size is None else value:
                first = numbered(types, field.type, one, first)
        elif field.type != "string":
            count = 1 if field.size is None else len(value)
            made = (np.arange(count) + first).astype(dtype_of(field.type))
            setattr(message, field.name, made[0].item() if field.size is None else made)
            first += count
    return first


@pytest.mark.parametrize(
    ("name", "about"),
    [
        ("geometry_msgs/msg/Twist", {"fields": ["linear.x", "angular"]}),
        ("sensor_msgs/msg/Imu", {"fields": ["orientation", "linear_acceleration"]}),
        ("sensor_msgs/msg/BatteryState", {"fields": ["voltage", "present"]}),
        (JOINTS, {"fields": ["velocity", "position"], "joints": ["c", "a"]}),
        (JOINTS, {"fields": ["effort[1:3]", "header.stamp.sec"]}),
        ("tf2_msgs/msg/TFMessage", {"fields": ["transforms[1].transform.rotation"]}),
    ],
)
def test_what_has_the_layout_of_an_earlier_message_is_not_decoded(
    types, name, about
) -> None:
    record = reading(types, Subscribe(topic="t", type=name, link="l", **about), "here")

    def made(first, names=("a", "b", "c")):
        message = types.new(name)
        if name == JOINTS:
            message.name = list(names)
            for field in ("position", "velocity", "effort"):
                setattr(message, field, np.zeros(3))
        elif hasattr(message, "transforms"):
            kind = "geometry_msgs/msg/TransformStamped"
            message.transforms = [types.new(kind) for _ in range(2)]
        numbered(types, name, message, first)
        return types.encode(name, message)

    got = np.empty((), record.form)
    taker = record.taker(types, name, made(1), got)
    padded = record.taker(types, name, made(1) + bytes(3), got)
    for first in (1, 50):
        data = made(first)
        wanted = np.empty((), record.form)
        record.read(types.decode(name, data), wanted)
        for one, message in ((taker, data), (padded, data + bytes(3))):
            got[:] = 0
            assert one.take(message)
            assert got.tolist() == wanted.tolist()
        assert not taker.take(data + bytes(3))
    assert not taker.take(made(1)[:-8])
    if name == JOINTS:
        assert not taker.take(made(1, ("b", "a", "c"))), "the joints have moved"
        assert not taker.take(made(1, ("a", "b", "long")))
        stamp = types.decode(name, data).header.stamp
        assert taker.stamp_ns == nanoseconds(stamp)


@pytest.mark.parametrize(
    "kind", [f"{sign}nt{bits}" for sign in ("I", "UI") for bits in (8, 16, 32, 64)]
)
def test_numbers_of_every_type_are_copied_natively(types, kind) -> None:
    name, dtype = f"std_msgs/msg/{kind}MultiArray", np.dtype(kind.lower())
    limits = [np.iinfo(dtype).min, np.iinfo(dtype).max, 7]
    message, to = types.new(name), np.zeros(2)
    message.data = np.zeros(3, dtype)
    about = Subscribe(topic="t", type=name, link="l", fields=["data[0:2]"])
    record = reading(types, about, "here")
    taker = record.taker(types, name, types.encode(name, message), to)
    message.data = np.array(limits, dtype)
    assert taker.take(types.encode(name, message))
    assert to.tolist() == [float(one) for one in limits[:2]]


@pytest.mark.parametrize(
    ("number", "raw", "expected"),
    [
        ("Bool", b"\1", 1.0),
        ("Bool", b"\2", 1.0),
        ("Int8", b"\xff", -1.0),
        ("Int16", b"\xfe\xff", -2.0),
        ("Float32", b"\0\0\xc0\x3f", 1.5),
    ],
)
def test_the_layout_of_a_short_message_is_learnt(types, number, raw, expected) -> None:
    """Shorter ones than a stamp have none; any byte but 0 is true."""
    name = f"std_msgs/msg/{number}"
    link = Link(types, name, fields=["data"])
    with contextlib.closing(link.end):
        link.take(types.new(name))
        assert link.end._taker
        link.end._types = None  # nothing more is decoded
        link.take(None, raw=b"\0\1\0\0" + raw)
        assert link.end._writer.value.tolist() == [expected]


@pytest.mark.parametrize(
    ("first", "end", "place", "order"),
    [(0, 2, 5, None), (1, 3, 4, None), (0, 1, 4, None), (0, 2, 4, [0, 2])],
)
def test_no_number_is_copied_from_or_to_another_place(first, end, place, order) -> None:
    kind, places = np.dtype("f8"), order and np.array(order, np.uint32)
    part = Slice(first, end, place, 2, kind, places)
    with pytest.raises(ValueError, match="do not fit the message"):
        Taker(bytes(20), bytes(20), [part], np.zeros(2), -1)


def test_no_place_is_outside_of_the_message() -> None:
    here = np.zeros(2)
    Filler(bytearray(24), [(8, here)], [16])
    Taker(bytes(20), bytes(20), [], here, 12)
    with pytest.raises(ValueError, match="numbers do not fit the message"):
        Filler(bytearray(23), [(8, here)], [])
    with pytest.raises(ValueError, match="numbers do not fit the message"):
        Filler(bytearray(24), [(8, np.zeros(4)[::2])], [])
    with pytest.raises(ValueError, match="stamps do not fit the message"):
        Filler(bytearray(11), [], [4])
    with pytest.raises(ValueError, match="stamps do not fit the message"):
        Taker(bytes(20), bytes(20), [], here, 13)
    with pytest.raises(ValueError, match="bytes that stay do not fit the message"):
        Taker(bytes(20), bytes(19), [], here, -1)
    part = Slice(0, 2, 4, 2, np.dtype("f8"), None)
    for to in (np.zeros(2, "f4"), np.zeros(4)[::2]):
        with pytest.raises(ValueError, match="numbers do not fit the message"):
            Taker(bytes(20), bytes(20), [part], to, -1)


def test_a_sender_that_encodes_otherwise_is_decoded(types) -> None:
    name = "std_msgs/msg/Float64"
    about = Subscribe(topic="t", type=name, link="l", fields=["data"])
    other_order = b"\0\0\0\0" + np.array([1.5], ">f8").tobytes()
    record = reading(types, about, "here")
    assert record.taker(types, name, other_order, np.empty(1)) is None
    link = Link(types, name, fields=["data"])
    with contextlib.closing(link.end):
        link.take(types.new(name))
        assert link.end._taker, "the layout of another sender"
        link.take(None, raw=other_order)
        assert link.end._writer.value.tolist() == [1.5]


def test_a_field_named_header_may_be_something_else() -> None:
    types, name = MessageTypes(), "my_msgs/msg/Count"
    types.add(name, "uint32 header\nfloat64 data\n")
    with contextlib.closing(Link(types, name, fields=["data"]).end) as end:
        link = SimpleNamespace(end=end, types=types, number=0, about=end.about)
        message = types.new(name)
        for message.data in (1.5, 2.5):
            Link.take(link, message)
            assert end._writer.value.tolist() == [message.data]
        assert end._taker
    about = Subscribe(topic="t", type=name, link="l", fields=["data"], stamp="header")
    with pytest.raises(ConfigError, match="no header with a stamp"):
        reading(types, about, "here")


def test_the_layout_of_a_long_message_is_not_learnt(types) -> None:
    """It takes many times as long as to decode it."""
    link = Link(types, JOINTS, fields=["position[0:2]"])
    with contextlib.closing(link.end):
        link.take(joint_state(types, [], position=np.zeros(1000)))
        assert link.end._taker is None
        link.take(joint_state(types, [], position=np.zeros(2)))
        assert link.end._taker


def test_a_trajectory_is_rows_of_points(types) -> None:
    name, point = (f"trajectory_msgs/msg/JointTrajectory{one}" for one in ("", "Point"))
    message = types.new(name)
    message.joint_names = ["b", "a"]
    for k in range(2):
        one = types.new(point)
        one.positions = np.array([k + 0.5, k + 0.25])
        one.time_from_start.sec, one.time_from_start.nanosec = k, 500_000_000
        message.points.append(one)
    message.points[1].velocities = np.array([7.0, 8.0])
    found = record(types, message, name, joints=["a", "b"], points=3)
    nan = np.nan
    assert found["goal"] == 0, "of no action"
    np.testing.assert_array_equal(
        found["rows"],
        [
            [0.5, 0.25, 0.5, nan, nan, nan, nan],
            [1.5, 1.25, 1.5, 8.0, 7.0, nan, nan],
            [nan] * 7,
        ],
    )
    with pytest.raises(ProtocolError, match="too many points"):
        record(types, message, name, joints=["a", "b"], points=1)
    message.points[0].positions = np.array([1.0])
    with pytest.raises(ProtocolError, match="too few positions"):
        record(types, message, name, joints=["a", "b"])


@pytest.mark.parametrize(
    ("name", "about", "said"),
    [
        (JOINTS, {}, "which numbers"),
        (JOINTS, {"fields": ["position"]}, "any number of elements"),
        ("trajectory_msgs/msg/JointTrajectory", {}, "needs its joints"),
        (
            "std_msgs/msg/Float64",
            {"fields": ["data"], "joints": ["a"]},
            "no names of j",
        ),
        ("std_msgs/msg/Float64", {"fields": ["data"], "stamp": "header"}, "no header"),
        ("std_msgs/msg/Nothing", {"fields": ["data"], "stamp": "header"}, "no message"),
    ],
)
def test_what_cannot_be_subscribed_is_told(types, name, about, said) -> None:
    with pytest.raises(ConfigError, match=said):
        reading(types, Subscribe(topic="t", type=name, link="x", **about), "here")


# -- links ----------------------------------------------------------------------------


class Bytes(bytes):
    """Bytes as zenoh has them."""

    def to_bytes(self):
        return bytes(self)


class Link:
    """A topic with its link, and what it tells."""

    def __init__(self, types, name, **about):
        self.types, self.told = types, []
        self.about = Subscribe(topic="/t", type=name, link="x", **about)
        form = reading(types, self.about, "here")
        self.end = Incoming(types, self.about, form, Warnings(self.told.append))
        self.number = 0

    def take(self, message, *, step=1, raw=None, waited=0.0):
        self.number += step
        name = self.about.type
        data = raw if raw is not None else self.types.encode(name, message)
        note = Attachment(self.number, 0, bytes(16)).pack()
        payload, attached = (Bytes(one) for one in (data, note))
        sample = SimpleNamespace(payload=payload, attachment=attached)
        self.end.take(sample, now_ns() - round(waited * 1e9))


@pytest.fixture
def link(types):
    made = Link(types, JOINTS, fields=["position[0:2]"], stamp="header")
    yield made
    made.end.close()


def test_a_message_is_a_record_with_the_age_of_its_header(types, link) -> None:
    message = joint_state(types, [], position=[1, 2])
    set_stamp(message.header.stamp, time.time_ns() - 3_000_000_000)
    with tbuf.Reader("ros2:x", ("f8", 2)) as reader:
        link.take(message)
        assert reader.read()
        assert reader.value.tolist() == [1.0, 2.0]
        assert 3.0 <= reader.age_ns() * 1e-9 < 60.0
        set_stamp(message.header.stamp, 5)
        with pytest.raises(ProtocolError, match="not of this time"):
            link.take(message)
        assert not reader.read(), "so its age grows"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(types, link, bad) -> None:
    """A task that copies it would go into ERROR, and any node can send it."""
    message = joint_state(types, [], position=[1, 2])
    set_stamp(message.header.stamp, time.time_ns())
    with tbuf.Reader("ros2:x", ("f8", 2)) as reader:
        message.position = np.array([1.0, bad])
        with pytest.raises(ProtocolError, match=r"is not finite.*got 1 "):
            link.take(message)
        assert not reader.read()
        message.position = np.array([1.0, 2.0, bad])
        link.take(message)
        assert reader.read(), "that one is not wanted"
        message.position = np.array([1.0, bad, 2.0])
        with pytest.raises(ProtocolError, match=r"is not finite.*got 1 "):
            link.take(message)
        assert not reader.read(), "nor one whose layout is known"


@pytest.mark.parametrize(
    ("field", "place"), [("position", 0), ("position", 1), ("effort", 0)]
)
def test_no_number_of_a_known_layout_may_be_not_finite(types, field, place) -> None:
    link = Link(types, JOINTS, fields=["position[0:2]", "effort[0:1]"])
    with contextlib.closing(link.end):
        message = joint_state(types, [], position=[1, 2], effort=[3])
        link.take(message)
        assert link.end._taker
        getattr(message, field)[place] = np.inf
        with pytest.raises(ProtocolError, match=f"{field}.* is not finite"):
            link.take(message)


@pytest.mark.parametrize("stamp", ["arrival", "header"])
def test_the_age_of_a_message_that_has_waited_begins_at_its_arrival(
    types, stamp
) -> None:
    link = Link(types, JOINTS, fields=["position[0:2]"], stamp=stamp)
    message = joint_state(types, [], position=[1, 2])
    set_stamp(message.header.stamp, time.time_ns() - 9_000_000_000)
    with contextlib.closing(link.end), tbuf.Reader("ros2:x", ("f8", 2)) as reader:
        link.take(message, waited=5.0)
        assert reader.read()
        least = 5.0 if stamp == "arrival" else 9.0
        assert least <= reader.age_ns() * 1e-9 < least + 3.0


def test_a_stamp_ahead_of_our_clock_is_refused(types, link) -> None:
    """Each delay would be hidden behind the other clock's lead."""
    message = joint_state(types, [], position=[1, 2])
    with tbuf.Reader("ros2:x", ("f8", 2)) as reader:
        set_stamp(message.header.stamp, time.time_ns() + 50_000_000)
        link.take(message)
        assert reader.read()
        assert reader.age_ns() >= 0
        set_stamp(message.header.stamp, time.time_ns() + 60_000_000_000)
        with pytest.raises(ProtocolError, match=r"s ahead.*synchronize the clocks"):
            link.take(message)
        assert not reader.read()


def test_what_was_not_read_is_counted_and_told_once(types, link) -> None:
    message = joint_state(types, [], position=[1, 2])
    set_stamp(message.header.stamp, time.time_ns())
    for step in (1, 1, 1, 10, 20):
        link.take(message, step=step)
    assert link.end.lost == 28
    assert len(link.told) == 1
    assert "messages come faster than max_hz = 1000" in link.told[0]


def test_long_and_broken_messages_are_refused(link) -> None:
    with pytest.raises(ProtocolError, match="too long"):
        link.take(None, raw=bytes(LONGEST + 1))
    for raw in (b"", b"\0\1\0\0", bytes(100), b"\0\1\0\0" + b"\xff" * 64):
        with pytest.raises(ProtocolError, match="this is no message"):
            link.take(None, raw=raw)


@pytest.mark.usefixtures("link")
def test_a_link_has_one_bridge(types) -> None:
    with pytest.raises(XmTakenError):
        Link(types, JOINTS, fields=["position[0:2]"])


# -- the file -------------------------------------------------------------------------


def test_without_a_file_names_and_units_decide() -> None:
    more = [
        Variable(name="Q_REF", type="double", nelem=3, units="deg"),
        Variable(name="T_REF", type="double", nelem=3, units="N*m"),
    ]
    found = by_names([*VARIABLES.values(), *more]).publish
    assert found[0].topic == "joint_states/mez"
    assert found[0].fields == {
        "position": "Q_MEZ",
        "velocity": "Q^_MEZ",
        "effort": "T_MEZ",
    }
    assert found[0].constants == {"name": ["joint1", "joint2", "joint3"]}
    assert {one.fields["data"]: one.topic for one in found[1:]} == {
        "DEG": "variables/deg",
        "X": "variables/x",
        "V": "variables/v",
        "ON": "variables/on",
        "COUNT": "variables/count",
        "Q_REF": "variables/q_ref",
        "T_REF": "variables/t_ref",
    }


TOPIC = "[[publish]]\ntopic = 'a'\ntype = 'b'\nfields = {}\n"
LINK = "[[subscribe]]\ntopic = 'a'\ntype = 'b'\n"
ACTION = """[[action]]
name = "a"
link = "b"
joints = []
desired = "A"
actual = "B"
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[publish]", r"t.toml:1:10: .*at the end of an array declaration \(expected"),
        ("nothing = 1", "unknown key 'nothing'.*expected domain node"),
        ("[[publishes]]", "unknown key 'publishes'.*did you mean publish?"),
        (f"{TOPIC}max_hertz = 1", r"t.toml: publish\[0\]: unknown .*mean max_hz?"),
        (f"publish = 3\n{LINK}", r"t.toml: publish: .*got Expected `array`"),
        (f"{LINK}depth = '1'", r"subscribe\[0\].depth: .*got Expected `int`"),
        (f"{LINK}link = 'ros2:a'", "a: 'ros2:a' is no name of a link"),
        (f"{LINK}link = ''", "a: '' is no name of a link"),
        (f"{LINK}link = 'a'\njoints = ['b', 'b']", "a: the joint b is there twice"),
        (f"{LINK}link = 'a'\npoints = 10000000", "a: points is out .*1 to 131071"),
        (f"{LINK}link = 'a'\ndepth = {2**70}", "depth is out of bounds"),
        (f"{ACTION}feedback_hz = 1", "a: feedback_hz is out of .*5 to 1000, got 1"),
        (f"{ACTION}feedback_hz = inf", "a: feedback_hz is out of bounds"),
        (f"node = 'n'\n{TOPIC}{TOPIC.replace('a', '/n/a', 1)}", "/n/a is there twice"),
        ("domain = 233", "no ROS domain"),
        ('node = "a b"', "no name of ROS"),
        ('[[publish]]\ntopic = "a"', "missing required field"),
        (2 * TOPIC, "/SUBSYSTEM/a is there twice"),
        (f"{TOPIC}max_hz = 0.0", "a: max_hz is out of bounds"),
        (f"{TOPIC}max_hz = nan", "a: max_hz is out of bounds"),
        (f"{LINK}link = 'a'\njoints = ['b']\npoints = 32768", "1 to 32767, got 32768"),
    ],
)
def test_a_wrong_file_is_told(tmp_path, text, said) -> None:
    (tmp_path / "t.toml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        read_topics(tmp_path / "t.toml")


def test_messages_of_a_user(tmp_path) -> None:
    folder = tmp_path / "mine_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Grip.msg").write_text("Finger[2] fingers\nfloat32 force # N\n")
    (folder / "Finger.msg").write_text("float64[] angles\n")
    types = MessageTypes([tmp_path])
    got = filled(
        types, "mine_msgs/msg/Grip", {"force": "X[1]", "fingers[1].angles": "Q_MEZ"}
    )
    assert (got.force, list(got.fingers[1].angles)) == (2.0, [1, 2, 3])
    (folder / "Bad.msg").write_text("float64 1x\n")
    with pytest.raises(ConfigError, match=r"Bad.msg.*no definition"):
        MessageTypes([tmp_path])
    with pytest.raises(ConfigError, match="no messages"):
        MessageTypes([folder])


def use(folder):
    """Use the messages and the action of a folder, as a bridge does."""
    types = MessageTypes([folder])
    types.add_following()
    types.must_have("a/msg/B")


@pytest.fixture
def bounded(tmp_path):
    """Types with lists that have at most three numbers, two texts, two messages."""
    folder = tmp_path / "a" / "msg"
    folder.mkdir(parents=True)
    (folder / "B.msg").write_text("float64[<=3] few\nstring[<=2] words\nbool x\n")
    (folder / "C.msg").write_text("B[<=2] parts\nfloat64[] many\n")
    return MessageTypes([tmp_path])


@pytest.mark.parametrize(
    ("about", "said"),
    [
        ({"fields": {"parts[1].few": "X"}}, r"here: the list parts\[1\].few .*7"),
        ({"fields": {"parts[2].x": "ON"}}, r"parts\[2\] are no .*elements 0 to 1"),
        (
            {"fields": {"parts[0].x": "ON"}, "constants": {"parts[0].words": [*"abc"]}},
            r"here: the list parts\[0\].words .*at most 2 .*a/msg/B says, got 3",
        ),
    ],
)
def test_a_published_list_longer_than_its_bound_is_refused(bounded, about, said):
    with pytest.raises(ConfigError, match=said):
        filled(bounded, "a/msg/C", **about)


def test_a_list_as_long_as_its_bound_is_published(bounded) -> None:
    fields = {"parts[1].few": "Q_MEZ", "many": "X"}
    got = filled(bounded, "a/msg/C", fields)
    assert list(got.parts[1].few) == [1, 2, 3]
    assert len(got.many) == 7


def test_a_list_longer_than_its_bound_is_not_taken(bounded) -> None:
    """Its sender has the same type without the bound, so the bytes are a message."""
    message = bounded.new("a/msg/C")
    message.parts = [bounded.new("a/msg/B")]
    message.parts[0].few = np.zeros(4)
    data = bytes(bounded.store.serialize_cdr(message, "a/msg/C"))
    said = r"parts\[0\].few is too long .*at most 3 elements, as a/msg/B says, got 4"
    with pytest.raises(ProtocolError, match=said):
        bounded.decode("a/msg/C", data)
    message.parts[0].few = np.zeros(3)
    data = bounded.encode("a/msg/C", message)
    assert len(bounded.decode("a/msg/C", data).parts[0].few) == 3
    about = Subscribe(topic="t", type="a/msg/C", fields=["parts[0].few[0:4]"], link="l")
    with pytest.raises(ConfigError, match="elements 0 to 2"):
        reading(bounded, about, "here")


def test_joints_beyond_the_bound_of_a_field_are_refused(bounded) -> None:
    bounded.add("a/msg/J", "string[] name\nfloat64[<=2] position\n")
    about = Subscribe(
        topic="t", type="a/msg/J", fields=["position"], joints=[*"xyz"], link="l"
    )
    said = r"^here: position has no room for 3 joints \(expected at most 2"
    with pytest.raises(ConfigError, match=said):
        reading(bounded, about, "here")
    about.joints.pop()
    assert reading(bounded, about, "here").form == ("f8", (2,))


@pytest.mark.parametrize("text", ["[<=0]", "[0]", "[<=-1]"])
def test_a_list_without_room_is_refused(tmp_path, text) -> None:
    """rosbags takes the first two for `[]`, which has another CDR."""
    folder = tmp_path / "a" / "msg"
    folder.mkdir(parents=True)
    file = folder / "B.msg"
    file.write_text(f"float64[] x  # no [0] \nfloat64{text} y\n")
    with pytest.raises(ConfigError, match=f"^{file}: .*got float64{re.escape(text)}"):
        MessageTypes([tmp_path])


@pytest.mark.parametrize("text", ["B", "B[]", "a/B[<=3]"])
def test_a_message_that_contains_itself_is_refused(tmp_path, text) -> None:
    folder = tmp_path / "a" / "msg"
    folder.mkdir(parents=True)
    for name, its in (("A", "B"), ("B", "C"), ("C", text)):
        (folder / f"{name}.msg").write_text(f"{its} inner\nfloat64 x\n")
    types = MessageTypes([tmp_path])
    said = r"B.msg: .*a/msg/B contains itself .*got a/msg/B has a/msg/C has a/msg/B\);"
    with pytest.raises(ConfigError, match=said):
        types.must_have("a/msg/A")


GOAL = "control_msgs/action/FollowJointTrajectory.action"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a/msg/B.msg", b"flot64 x\n", r"B.msg: the field x.*did you mean float64"),
        ("a/msg/B.msg", b"other/C x\n", r"B.msg: .*unknown type C.*give its .msg file"),
        ("a/msg/B.msg", b"\xff", r"B.msg: the definition cannot be read"),
        (GOAL, b"\xff", r"FollowJointTrajectory.action: .*cannot be read"),
        (GOAL, b"a/B x\n---\n---\n", "FollowJointTrajectory.action: .*unknown type B"),
        (GOAL, b"float64 x\n---\n---\n", "the goal of control_msgs.*field trajectory"),
        (GOAL, b"float64 x\n---\n", "FollowJointTrajectory.action: .*got 2 parts"),
    ],
)
def test_a_wrong_definition_is_told_with_its_file(tmp_path, name, text, said) -> None:
    file = tmp_path / name
    file.parent.mkdir(parents=True)
    file.write_bytes(text)
    with pytest.raises(ConfigError, match=said):
        use(tmp_path)


def test_a_message_that_is_not_used_may_have_unknown_ones(tmp_path) -> None:
    """A package of a user may have messages that need others, or a `wstring`."""
    texts = {"msg/B.msg": "other/C x\n", "msg/D.msg": "wstring x\n"}
    texts |= {"action/E.action": "other/C x\n---\n---\n", "msg/F.msg": "char x\n"}
    for name, text in texts.items():
        file = tmp_path / "a" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    types = MessageTypes([tmp_path])
    types.add_following()
    types.must_have("a/msg/F")
    assert types.new("a/msg/F").x == 0


def test_messages_of_one_folder_may_have_those_of_another(tmp_path) -> None:
    for name, text in (("one/a/msg/B.msg", "c/D x\n"), ("two/c/msg/D.msg", "bool y\n")):
        file = tmp_path / name
        file.parent.mkdir(parents=True)
        file.write_text(text)
    types = MessageTypes([tmp_path / "one", tmp_path / "two"])
    types.must_have("a/msg/B")
    assert types.new("a/msg/B").x.y is False
