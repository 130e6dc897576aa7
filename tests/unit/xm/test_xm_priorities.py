"""Values that wait for a busy link take no room of signs of life."""

from __future__ import annotations

import json
import threading
from types import SimpleNamespace

import zenoh
from watching import free_port, wait_for

from pbonet.node.agent.heartbeat import Heartbeat
from pbonet.xm.net import VALUES_PRIORITY, direct, session

LARGE, SMALL = bytes(60_000), bytes(1000)
BEAT = bytes(3000)
"""More than is free in a batch that has no room for a small value."""


def link(port):
    """Return the sessions of two agents with a link between them."""
    end = f"tcp/127.0.0.1:{port}"
    one = zenoh.open(
        session._config(
            mode="router",
            listen={"endpoints": [end]},
            connect={"endpoints": []},
        )
    )
    other = zenoh.open(
        session._config(
            mode="router",
            listen={"endpoints": ["tcp/127.0.0.1:0"]},
            connect={"endpoints": [end]},
        )
    )
    return one, other


def priority_of_beats():
    """Return the priority with which an agent gives signs of life."""
    found = []
    fake = SimpleNamespace(
        declare_subscriber=lambda *_, **__: None,
        declare_publisher=lambda *_, priority, **__: found.append(priority),
    )
    me = SimpleNamespace(domain="d", name="arm0", machine="here")
    beats = Heartbeat(fake, me, print)
    beats.join(["cell"])
    return found[0]


def test_a_sign_of_life_passes_a_link_that_has_no_room_for_values() -> None:
    sender, receiver = link(free_port())
    got, goes_on = [], threading.Event()

    def take(sample):
        got.append((str(sample.key_expr), len(sample.payload)))
        assert goes_on.wait(60)

    with sender, receiver:
        declared = receiver.declare_subscriber("t/**", direct(take))
        drop = zenoh.CongestionControl.DROP
        values = sender.declare_publisher(
            "t/value", priority=VALUES_PRIORITY, congestion_control=drop
        )
        beats = sender.declare_publisher(
            "t/beat", priority=priority_of_beats(), congestion_control=drop
        )
        wait_for(lambda: values.matching_status.matching, "the receiver")
        sent = 600 * [LARGE] + 100 * [SMALL]
        for one in sent:
            values.put(one)
        beats.put(BEAT)
        goes_on.set()
        wait_for(lambda: ("t/beat", len(BEAT)) in got, "the sign of life")
        assert len(got) < len(sent), "values were dropped: there was no room"
        declared.undeclare()


def test_the_queue_for_values_is_short() -> None:
    config = session._config(mode="client", connect={"endpoints": []})
    sizes = json.loads(config.get_json("transport/link/tx/queue/size"))
    assert VALUES_PRIORITY == zenoh.Priority.INTERACTIVE_HIGH
    assert sizes["interactive_high"] == session.BATCHES == 1
    assert priority_of_beats() == zenoh.Priority.REAL_TIME
    assert sizes["real_time"] > 1
