"""Two subsystems on two machines, linked by two `.rmod` files alone."""

import os
import signal

import numpy as np
import pytest
from far_rig import LEASE_MS, Cell, Site
from nodekit import Master, rmod
from watching import wait_for

from pbonet.errors import NodeError
from pbonet.tbuf.native import parts
from pbonet.xm.net import key_expressions

pytestmark = pytest.mark.timeout(300)
TABLE = """
NAME Z
TYPE double
DESC what one of them tells the other
UNITS none
NELEM 2
MAXAGE 0.4

EOF
"""
SEND = """
MODULE tbuf_send
DESC tells the arm
INCONST none
OUTCONST none
INVAR Z
OUTVAR none
TASKTYPE periodic
FREQ 200
LOCAL
LINK count
EOF
"""
RECEIVE = """
MODULE tbuf_receive
DESC what vision tells
INCONST none
OUTCONST none
INVAR none
OUTVAR Z
TASKTYPE periodic
FREQ 200
LOCAL
LINK vision:count
MAXAGE 0.4
EOF
"""
COUNT = """
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Counter(PortBasedObject):
    y: A[Vector, OutVar("Y", "2", "none", "how often, and its double")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self.y[1] = 2.0 * self.y[0]
"""


@pytest.fixture
def linked(tmp_path):
    """Both machines, and a master at each; the arm's is there first."""
    (tmp_path / "counter.py").write_text(COUNT)
    pair, sites = Cell(LEASE_MS), []
    try:
        pair.start(tmp_path)
        sites = [Site(pair.b), Site(pair.a)]
        arm = Master(sites[0], "arm0", "arm")
        arm.open_table(TABLE)
        arm.spawn("from_vision", "tbuf_receive", text=RECEIVE)
        arm.on("from_vision")
        vision = Master(sites[1], "vision0", "vision")
        vision.open_table(TABLE)
        vision.spawn("counter", "counter", text=rmod("counter", "Z"))
        vision.spawn("to_arm", "tbuf_send", text=SEND)
        yield pair, arm, vision
    finally:
        for site in sites:
            site.session.close()
        pair.close()


def fresh(arm, beyond=0.0):
    """Wait until the arm has more than so many counts, not stale; return it."""

    def seen():
        try:
            value = arm.value("Z")
        except NodeError:
            return False  # our own way to the agent is still coming back
        return not value.stale and value.values[0] > beyond and value

    found = wait_for(seen, "fresh values")
    assert found.values[1] == 2 * found.values[0], "a whole record"
    assert "from_vision" in found.writer
    return found.values[0]


def stale(arm):
    """Wait until what the arm has is stale, although its task goes on."""
    wait_for(lambda: arm.value("Z").stale, "stale values")
    assert arm.status("from_vision").state == "ON"


def test_two_subsystems_by_rmod_files_alone(linked):
    pair, arm, vision = linked
    assert arm.value("Z").stale, "nothing came yet"
    vision.on("counter")
    vision.on("to_arm")
    count = fresh(arm)

    os.kill(vision.status("to_arm").tid, signal.SIGKILL)
    stale(arm)
    wait_for(
        lambda: "nothing arrived for" in arm.status("from_vision").warning, "a word"
    )
    vision.kill("to_arm")
    vision.spawn("to_arm", "tbuf_send", text=SEND)
    vision.on("to_arm")
    count = fresh(arm, count)

    vision.off("counter")
    stale(arm)  # the variable of the sender is stale itself, so nothing is sent
    vision.on("counter")
    count = fresh(arm, count)

    pair.a.kill_agent()
    stale(arm)
    pair.a.start()  # its tasks have gone on, and nobody says anything to them
    fresh(arm, count)


def test_a_cycle_wakes_the_agent_when_it_is_over(linked):
    """Records of a 200 Hz task go out one by one, not when the agent looks around."""
    pair, arm, vision = linked
    vision.on("counter")
    vision.on("to_arm")
    fresh(arm)
    numbers = []
    key = key_expressions.link(pair.domain, "vision:count", "data", "vision0", "arm0")
    subscriber = vision.nodes.session.declare_subscriber(
        key, lambda one: numbers.append(parts(one.payload.to_bytes())[0])
    )
    wait_for(
        lambda: len(numbers) > 100 and np.median(np.diff(numbers[-101:])) < 5,
        "a hundred records one by one, for a look around finds one in ten",
    )
    subscriber.undeclare()


def test_the_receivers_agent_is_killed_and_comes_back(linked):
    pair, arm, vision = linked
    vision.on("counter")
    vision.on("to_arm")
    count = fresh(arm)
    pair.b.kill_agent()
    pair.b.start()
    fresh(arm, count)
