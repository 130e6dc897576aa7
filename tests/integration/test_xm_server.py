"""A server as its author writes it: `sync` waits for a message, `cycle` works on it."""

import time

import pytest
from nodekit import alive, rmod
from watching import wait_for

from pbonet import xm
from pbonet.errors import XmDestroyedError
from pbonet.xm import messages as m

SERVER = '''
    """Adds up what it is sent: an aperiodic server."""

    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector, xm


    class Adder(PortBasedObject):
        """y = (messages, their sum)."""

        y: A[Vector, OutVar("Y", "2", "none", "messages, and their sum")]

        def init(self) -> None:
            self.queue = xm.queue("numbers", policy=xm.Policy.HPF)

        def sync(self) -> None:
            self.queue.wait()

        def cycle(self, dt: float) -> None:
            self.y[0] += 1.0
            self.y[1] += float(self.queue.try_receive())

        def kill(self) -> None:
            self.queue.destroy()
'''
GATE = '''
    """Counts the signals of a semaphore."""

    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector, xm


    class Gate(PortBasedObject):
        """y = (signals, 0)."""

        y: A[Vector, OutVar("Y", "2", "none", "signals")]

        def init(self) -> None:
            self.signal = xm.semaphore("signal", initial=0)

        def sync(self) -> None:
            self.signal.p()

        def cycle(self, dt: float) -> None:
            self.y[0] += 1.0

        def kill(self) -> None:
            self.signal.destroy()
'''


@pytest.fixture
def server(arm, nodes):
    """Return a function that spawns one of the two and turns it on."""

    def start(name, code):
        nodes.write_module(name, code)
        text = rmod(name).replace("periodic", "synchronous")
        assert arm.spawn("s", name, text=text).S == "Y"
        assert arm.on("s").state == "ON"
        return arm

    return start


def test_each_message_is_a_cycle(server):
    arm = server("adder", SERVER)
    numbers = xm.queue("numbers")
    for count, number in enumerate((3, 4, 5), 1):
        numbers.send(str(number).encode())
        wait_for(lambda: arm.value("Y0").values[0] == count, "its cycle")  # noqa: B023
    assert arm.value("Y0").values == [3.0, 12.0]
    numbers.close()
    assert arm.status("s").miss == 0


def test_commands_end_the_wait_and_messages_wait_for_on(server):
    arm = server("adder", SERVER)
    numbers = xm.queue("numbers")
    wait_for(lambda: numbers.waiting == 1, "it to wait")
    assert arm.ask(m.Get(task="s"), list[m.ParamValue]) == []
    wait_for(lambda: numbers.waiting == 1, "it to wait again")
    assert arm.off("s").state == "OFF"
    assert numbers.waiting == 0
    numbers.send(b"7")
    assert arm.on("s").state == "ON"
    wait_for(lambda: arm.value("Y0").values == [1.0, 7.0], "its cycle")
    tid = arm.status("s").tid
    assert arm.kill("s").state == "NOT-CREATED"
    assert not alive(tid)
    with pytest.raises(XmDestroyedError):
        numbers.send(b"8")
    numbers.close()


def test_a_semaphore_as_event(server):
    arm = server("gate", GATE)
    signal = xm.semaphore("signal")
    for _ in range(3):
        assert signal.v()
    wait_for(lambda: arm.value("Y0").values[0] == 3, "its cycles")
    wait_for(lambda: signal.waiting == 1, "it to wait")
    assert signal.p(time.monotonic_ns()) is xm.Taken.TIMED_OUT
    signal.close()


def test_stop_ends_the_wait(server):
    arm = server("adder", SERVER)
    stopped = arm.stop()
    assert (stopped.off, stopped.killed) == (["s"], [])
