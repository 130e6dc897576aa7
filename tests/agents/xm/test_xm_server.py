"""A server as its author writes it: `sync` waits for a message, `cycle` works on it."""

import os
import signal
import time

import pytest
from nodekit import alive, rmod
from watching import wait_for

from pbonet import xm
from pbonet.errors import XmDestroyedError
from pbonet.xm.net import messages as m

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
    """Return a function that spawns one of them and turns it on.

    The test itself is a program beside the tasks, at home in their domain.
    """
    xm.live_on("local", domain=nodes.domain)

    def start(name, code):
        nodes.write_module(name, code)
        text = rmod(name).replace("periodic", "synchronous")
        assert arm.spawn("s", name, text=text).S == "Y"
        assert arm.on("s").state == "ON"
        return arm

    yield start
    xm.live_on("local")


def test_each_message_is_a_cycle(server):
    arm = server("adder", SERVER)
    numbers = xm.queue("arm0:numbers")
    for count, number in enumerate((3, 4, 5), 1):
        numbers.send(str(number).encode())
        wait_for(lambda: arm.value("Y0").values[0] == count, "its cycle")  # noqa: B023
    assert arm.value("Y0").values == [3.0, 12.0]
    numbers.close()
    assert arm.status("s").miss == 0


def test_commands_end_the_wait_and_messages_wait_for_on(server):
    arm = server("adder", SERVER)
    numbers = xm.queue("arm0:numbers")
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
    gate = xm.semaphore("arm0:signal")
    for _ in range(3):
        assert gate.v()
    wait_for(lambda: arm.value("Y0").values[0] == 3, "its cycles")
    wait_for(lambda: gate.waiting == 1, "it to wait")
    assert gate.p(time.monotonic_ns()) is xm.Taken.TIMED_OUT
    gate.close()


def test_stop_ends_the_wait(server):
    arm = server("adder", SERVER)
    stopped = arm.stop()
    assert (stopped.off, stopped.killed) == (["s"], [])


def test_a_task_waits_with_its_criticality(server):
    """Of two tasks that wait, the more critical one is served first."""
    arm = server("gate", GATE)
    for name, out, crit in (("high", "Y1", 9), ("low", "Y2", 2)):
        text = rmod("gate", out=out).replace("periodic", "synchronous")
        arm.spawn(name, "gate", text=text, crit=crit)
        arm.on(name)
    gate = xm.semaphore("arm0:signal")
    wait_for(lambda: gate.waiting == 3, "all to wait")
    gate.v()
    wait_for(lambda: arm.value("Y1").values[0] == 1, "the more critical one's cycle")
    wait_for(lambda: gate.waiting == 3, "it to wait again")
    gate.v()
    wait_for(lambda: arm.value("Y1").values[0] == 2, "its second cycle")
    assert arm.value("Y0").values[0] == arm.value("Y2").values[0] == 0
    gate.close()


def mail(folder):
    """Return the files of semaphores and queues."""
    return sorted(p.name for p in folder.glob("*") if p.suffix in {".sem", ".queue"})


def test_nothing_is_left_when_an_rtpu_ends(server, nodes, shared_memory):
    server("keeper", SERVER.replace("self.queue.destroy()", "pass"))
    assert mail(shared_memory)
    nodes.agents.pop("arm0").stop()
    assert mail(shared_memory) == []


def test_nor_when_it_is_killed_with_its_task(server, nodes, shared_memory):
    arm = server("keeper", SERVER)
    assert mail(shared_memory)
    old = nodes.state("arm0").pid
    tid = arm.status("s").tid
    os.kill(old, signal.SIGKILL)
    os.kill(tid, signal.SIGKILL)
    nodes.wait_restarted("arm0", old)
    assert mail(shared_memory) == []
