"""Keys of the network whose messages are events of a server: `events` of agent.toml."""

import zenoh
from nodekit import rmod
from watching import wait_for

SERVER = '''
    """Adds up what the network sends."""

    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector, xm


    class Hears(PortBasedObject):
        """y = (messages, their sum)."""

        y: A[Vector, OutVar("Y", "2", "none", "messages, and their sum")]

        def init(self) -> None:
            self.queue = xm.queue("parts")

        def sync(self) -> None:
            self.queue.wait()

        def cycle(self, dt: float) -> None:
            message = self.queue.try_receive()
            if message is not None:
                self.y[0] += 1.0
                self.y[1] += float(message)

        def kill(self) -> None:
            self.queue.destroy()
'''


def test_messages_of_a_key_are_events_of_a_server(nodes):
    nodes.agent("arm0", events={"parts": "cell/*/part"})
    arm = nodes.master("arm0", "arm")
    nodes.write_module("hears", SERVER)
    text = rmod("hears", freq=50.0).replace("periodic", "sporadic")
    text = text.replace("FREQ 50", "FREQ 50\nCAPACITY 0.002")
    session = nodes.session
    key = zenoh.KeyExpr("cell/camera/part")
    for total in (10.0, 20.0):  # a queue that the module destroyed comes back
        arm.spawn("s", "hears", text=text)
        arm.on("s")
        before = arm.value("Y0").values
        for number in (1, 2, 3, 4):
            session.put(key, str(number))
        wait_for(
            lambda: arm.value("Y0").values == [before[0] + 4, before[1] + 10.0],  # noqa: B023
            "four events",
        )
        assert arm.value("Y0").values[1] == total
        assert arm.kill("s").state == "NOT-CREATED"


def test_what_is_too_long_is_told_once_and_harms_nothing(nodes):
    nodes.agent("arm0", events={"parts": "cell/part"})
    arm = nodes.master("arm0", "arm")
    for _ in range(3):
        nodes.session.put("cell/part", bytes(1 << 20))
    assert "parts" in arm.wait_event("XM_TOO_LONG").text
    assert len(arm.events("XM_TOO_LONG")) == 1
    assert arm.spawn("a", "counts").state == "OFF"


def test_what_is_longer_than_a_frame_reaches_no_rtpu_process(nodes):
    nodes.agent("arm0", events={"parts": "cell/part"})
    arm = nodes.master("arm0", "arm")
    tid = arm.spawn("a", "counts").tid
    arm.on("a")
    rtpu = nodes.state("arm0").pid
    wait = zenoh.CongestionControl.BLOCK
    nodes.session.put("cell/part", bytes((64 << 20) + 1), congestion_control=wait)
    first = arm.wait_event("XM_TOO_LONG")
    assert "parts" in first.text
    assert "got 67108865" in first.text
    for data in (bytes(1 << 20), bytes(1 << 20), b"1"):
        nodes.session.put("cell/part", data, congestion_control=wait)
    more = "2 more messages for the queue parts were too long"
    wait_for(lambda: more in [event.text for event in arm.events("XM_TOO_LONG")], more)
    assert nodes.state("arm0").pid == rtpu
    assert arm.wait_cycles("a", 5).tid == tid
