"""Nodes of ROS 2 have their own keys, and none of pbonet's, whatever is connected."""

from __future__ import annotations

import json

import pytest
import zenoh
from watching import free_port, wait_for

from pbonet.errors import NodeError, UnreachableError
from pbonet.xm.net import session

PBONET = "pbonet/default/rtpu/arm0/sbs"


def client(port):
    """Return a session as any program may open one."""
    return zenoh.open(
        zenoh.Config.from_json5(
            json.dumps({
                "mode": "client",
                "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
                "scouting": {"multicast": {"enabled": False}},
            })
        )
    )


def test_nodes_of_ros_have_no_key_of_pbonet() -> None:
    port, got = free_port(), []
    with (
        session.ros2(5, listen=f"tcp/127.0.0.1:{port}") as router,
        client(port) as one,
        client(port) as other,
    ):
        for near in (router, other):
            near.declare_queryable(PBONET, lambda query: query.reply(PBONET, b"!"))
            near.declare_queryable("5/a/b", lambda query: query.reply("5/a/b", b"yes"))
            near.declare_subscriber(
                "**", lambda sample: got.append(str(sample.key_expr))
            )
            near.declare_subscriber("5/**", lambda s: got.append(str(s.key_expr)))
        other.liveliness().declare_token("pbonet/default/rtpu/arm0/alive")
        token = other.liveliness().declare_token("@ros2_lv/5/z/0/0/NN/%/%/n")
        live = one.liveliness()
        wait_for(lambda: list(live.get("@ros2_lv/5/**")), "the token")
        assert token is not None
        for key in ("5/a", PBONET, "6/a", "5/b"):
            one.put(key, b"")
        wait_for(lambda: got.count("5/b") >= 2, "what is allowed")
        assert set(got) == {"5/a", "5/b"}
        assert [one for one in one.get("5/a/b") if one.ok]
        for key in (PBONET, "pbonet/**", "**"):
            assert [
                r for r in one.get(key) if r.ok and b"!" in r.ok.payload.to_bytes()
            ] == []
        assert list(live.get("pbonet/**")) == []


def test_where_no_router_is_and_where_one_is_told_of() -> None:
    port = free_port()
    with pytest.raises(UnreachableError, match="rmw_zenohd"):
        session.ros2(0, router=f"tcp/127.0.0.1:{port}")
    with session.ros2(0, listen=f"tcp/127.0.0.1:{port}"), pytest.raises(NodeError):
        session.ros2(0, listen=f"tcp/127.0.0.1:{port}")
    with pytest.raises(NodeError, match="not protected") as caught:
        session.ros2(0, listen="tcp/0.0.0.0:7447")
    assert "--insecure" in str(caught.value)
    assert "keys" not in str(caught.value), "nodes of ROS have none"
