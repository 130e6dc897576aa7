"""Topics whose last message comes later: transient local, between real sessions."""

from __future__ import annotations

from queue import Queue

import pytest
from watching import free_port, wait_for

from pbonet.ros2.message_types import MessageTypes
from pbonet.ros2.repeated_warnings import Warnings
from pbonet.ros2.ros_node import RosNode
from pbonet.ros2.wire_format import Node, Qos
from pbonet.xm.net import session

sdk = pytest.importorskip("zenoh_ros2_sdk")
from zenoh_ros2_sdk.qos import QosDurability, QosProfile  # noqa: E402

DOMAIN = 6
NUMBER = "std_msgs/msg/Float64"
LATCHED = Qos(depth=3, transient_local=True)


@pytest.fixture(scope="module")
def types():
    return MessageTypes()


@pytest.fixture
def nodes(types):
    """A node that is the router, and one that connects to it, and what they tell."""
    at, told = f"tcp/127.0.0.1:{free_port()}", []
    made = [
        RosNode(opened, Node(DOMAIN, "", name), types, Warnings(told.append))
        for name, opened in (
            ("one", session.ros2(DOMAIN, listen=at)),
            ("other", session.ros2(DOMAIN, router=at)),
        )
    ]
    for one in made:
        one.open()
    yield made, at
    for one in reversed(made):
        one.close()
    assert told == []


def number(types, value):
    return types.encode(NUMBER, types.store.types[NUMBER](data=value))


def test_who_comes_later_gets_the_last_message(types, nodes) -> None:
    (one, other), _ = nodes
    got = Queue()
    before = one.publisher("/early", NUMBER, LATCHED)
    for value in (1.0, 2.0, 3.0):
        before.put(number(types, value), 0)
    one.publisher("/plain", NUMBER, Qos()).put(number(types, 9.0), 0)

    def take(sample, _arrived):
        got.put(types.decode(NUMBER, sample.payload.to_bytes()).data)

    for topic in ("/early", "/plain", "/late"):
        other.subscribe(topic, NUMBER, LATCHED, take, 1000.0)
    assert got.get(timeout=60) == 3.0
    after = one.publisher("/late", NUMBER, LATCHED)
    after.put(number(types, 5.0), 0)
    assert got.get(timeout=60) == 5.0
    before.put(number(types, 4.0), 0)
    assert got.get(timeout=60) == 4.0
    assert got.empty(), "each once, and nothing of a volatile topic"


def test_another_implementation_gets_the_last_message(
    types, nodes, monkeypatch
) -> None:
    """The SDK asks the cache of the publisher as rmw_zenoh does."""
    (one, _), at = nodes
    latched = one.publisher("/tf_like", NUMBER, LATCHED)
    for value in (1.0, 2.0, 3.0, 4.0):
        latched.put(number(types, value), 0)
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", "scouting/multicast/enabled=false")
    monkeypatch.setenv("GIT_ALLOW_PROTOCOL", "none")  # it would fetch definitions
    node = sdk.ZenohSession.get_instance("127.0.0.1", int(at.rpartition(":")[2]))
    got: list[float] = []
    try:
        end = sdk.ROS2Subscriber(
            "/tf_like",
            NUMBER,
            lambda message: got.append(message.data),
            msg_definition="float64 data\n",
            domain_id=DOMAIN,
            qos=QosProfile(durability=QosDurability.TRANSIENT_LOCAL),
        )
        wait_for(lambda: got, "the last message")
        latched.put(number(types, 5.0), 0)
        wait_for(lambda: got[-1] == 5.0, "the next one")
        assert got == [4.0, 5.0]
        end.close()
    finally:
        node.session.close()
        sdk.ZenohSession._instance = None
