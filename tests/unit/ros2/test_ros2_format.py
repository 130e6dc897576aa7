"""Keys, tokens, attachments and hashes, as zenoh-ros2-sdk has them, and rmw_zenoh."""

from __future__ import annotations

import pytest

from pbonet.errors import ProtocolError
from pbonet.ros2.message_types import COMMAND, COMMAND_TEXT, MessageTypes
from pbonet.ros2.wire_format import (
    Attachment,
    End,
    Kind,
    Node,
    Qos,
    parse_token,
    ros_type,
)

attachment = pytest.importorskip("zenoh_ros2_sdk.attachment")
from zenoh_ros2_sdk import entity, keyexpr, qos, utils  # noqa: E402

HASHES = {
    # The beginnings of those of ROS 2 Jazzy.
    "std_msgs/msg/String": "df668c740482bbd48fb39d76",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f81d5d06ad9b4c4c6",
    "sensor_msgs/msg/Imu": "7d9a00ff131080897a5ec7e2",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c5",
    "rcl_interfaces/srv/GetParameters": "bf9803d5c74cf989a5de3e0c",
    "rcl_interfaces/srv/SetParameters": "56eed9a67e169f9cb6c1f987",
    "rcl_interfaces/srv/ListParameters": "3e6062bfbb27bfb8730d4cef",
    "rcl_interfaces/msg/Log": "e28ce254ca8abc06abf92773",
    "action_msgs/srv/CancelGoal": "573d8b0a534451d7bc2ac8c5",
    "action_msgs/msg/GoalStatusArray": "6c1684b00f177d37438febe6",
    "control_msgs/action/FollowJointTrajectory_SendGoal": "b13789dddc325a7a962825c4",
    "control_msgs/action/FollowJointTrajectory_GetResult": "e3ceb38e3e1867c8dc0f4601",
    "control_msgs/action/FollowJointTrajectory_FeedbackMessage": "80398fcb9674a790"
    "81a9906e",
}
NAMED = [
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/BatteryState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "trajectory_msgs/msg/JointTrajectory",
    "tf2_msgs/msg/TFMessage",
]
NODE = Node(3, "abc", "arm", "/lab")
END = End(
    NODE,
    4,
    Kind.PUBLISHER,
    "/a/b",
    "std_msgs/msg/String",
    "RIHS01_0",
    Qos(depth=5).text,
)


@pytest.fixture(scope="module")
def types():
    made = MessageTypes()
    made.add_following()
    return made


@pytest.mark.parametrize("name", HASHES)
def test_hashes_are_those_of_rmw_zenoh(types, name) -> None:
    assert types.hash(name).startswith(f"RIHS01_{HASHES[name]}")


@pytest.mark.parametrize("name", NAMED)
def test_hashes_are_those_of_another_implementation(types, name) -> None:
    text, *others = types.definition(name).split("=" * 80 + "\nMSG: ")
    parts = [one.partition("\n") for one in others]
    needs = {head.replace("/", "/msg/"): body for head, _, body in parts}
    assert types.hash(name) == utils.compute_type_hash_from_msg(name, text, needs)


def test_a_char_is_a_uint8_in_ros(types) -> None:
    text = "char one\nchar[3] three\nuint8 char\n"
    types.add("my_msgs/msg/Chars", text)
    numbers = text.replace("char one", "uint8 one").replace("char[", "uint8[")
    wanted = utils.compute_type_hash_from_msg("my_msgs/msg/Chars", numbers)
    assert types.hash("my_msgs/msg/Chars") == wanted


def test_the_hash_of_our_own_service_is_that_of_another_implementation(types) -> None:
    ask, answer = COMMAND_TEXT.split("---\n")
    assert types.hash(COMMAND) == utils.compute_service_type_hash(COMMAND, ask, answer)


def test_keys_and_tokens_are_those_of_another_implementation() -> None:
    of = entity.NodeEntity(3, "abc", 0, "arm", "/lab")
    assert keyexpr.node_liveliness_keyexpr(of) == NODE.token
    end = entity.EndpointEntity(
        of,
        4,
        entity.EntityKind.PUBLISHER,
        END.name,
        utils.ros2_to_dds_type(END.type),
        END.hash,
        END.qos,
    )
    assert keyexpr.endpoint_liveliness_keyexpr(end) == END.token
    key = keyexpr.topic_keyexpr(3, END.name, end.dds_type_name, END.hash)
    assert key == END.key == "3/a/b/std_msgs::msg::dds_::String_/RIHS01_0"


@pytest.mark.parametrize("reliable", [True, False])
def test_qualities_of_service_are_read_by_another_implementation(reliable) -> None:
    read = qos.QosProfile.decode(Qos(reliable=reliable, depth=7).text)
    assert read.reliability is qos.QosReliability(2 - reliable)
    assert (read.durability, read.history_depth) == (qos.QosDurability.VOLATILE, 7)
    late = qos.QosProfile.decode(Qos(transient_local=True).text)
    assert late.durability is qos.QosDurability.TRANSIENT_LOCAL


def test_tokens_are_read_as_they_were_written() -> None:
    assert parse_token(END.token) == END
    assert parse_token(NODE.token) == NODE
    root = Node(0, "z", "n")
    assert parse_token(root.token) == root
    assert ros_type("std_srvs::srv::dds_::SetBool_") == "std_srvs/srv/SetBool"


@pytest.mark.parametrize(
    "key",
    [
        "",
        "a/b",
        NODE.token.replace("/NN/", "/XX/"),
        NODE.token.replace("/3/", "/x/"),
        NODE.token.replace("/3/", "/\N{SUPERSCRIPT TWO}/"),
        NODE.token.replace("/3/", f"/{'9' * 5000}/"),
        NODE.token.replace("/3/", "//"),
        END.token.replace("/MP/", "/??/"),
        NODE.token.replace("/NN/", "/MP/"),
        END.token + "/more",
        END.token.replace("@ros2_lv", "other"),
    ],
)
def test_foreign_tokens_are_none(key) -> None:
    assert parse_token(key) is None


def test_attachments_are_those_of_another_implementation() -> None:
    ours = Attachment(7, 1_700_000_000_123_456_789, END.gid)
    theirs = attachment.Attachment(*ours)
    assert ours.pack() == theirs.to_bytes()
    assert Attachment.unpack(theirs.to_bytes()) == ours


@pytest.mark.parametrize("data", [b"", b"abc", bytes(33), bytes(40)])
def test_foreign_attachments_are_refused(data) -> None:
    with pytest.raises(ProtocolError, match="no attachment of rmw_zenoh"):
        Attachment.unpack(data)
