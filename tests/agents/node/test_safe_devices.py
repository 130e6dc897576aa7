"""Safe values on a bus, whatever ends: the task, its RTPU process, its agent, or all.

The bus is outside of what is killed: registers of a Modbus server in the test's
process, datagrams to its socket, and a file.
"""

from __future__ import annotations

import os
import signal
import socket
from contextlib import suppress

import pytest
from log_of_real_tasks import finish, record
from modbus_rig import serving
from nodekit import fork_server_of, rmod
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from watching import processes_of, wait_for

from pbonet.config import Entry
from pbonet.errors import MethodError
from pbonet.io.drivers import GUARD, port_claims
from pbonet.testing import verify

ACTS = """
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector
from pbonet.io.drivers import Mode, Wait, open_device


class Acts(PortBasedObject):
    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        self.fails = False
        how = {"mode": Mode.WRITE, "wait": Wait.NONE}
        self.plc = open_device("plc", 0, 1, safe=[0, 7], **how)
        self.memory = open_device("mem", mode=Mode.WRITE, safe={4: b"safe"})
        self.udp = open_device("udp", safe=b"safe", **how)

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self.plc.write([1000, 1000])
        self.memory.write(b"acts", 4)
        self.udp.write(b"acts")
        if self.fails:
            raise ValueError("it fails")

    def off(self) -> None:
        self.fails = self.task.arg == "fail"
        if self.fails:
            raise ValueError("off fails")
"""


class Bus:
    """What is on the buses, seen from outside.

    Args:
        plc: The address of a Modbus server.
        memory: The file.
        far: The socket to which datagrams are sent.
    """

    def __init__(self, plc, memory, far):
        self.memory, self.far, self.last = memory, far, b""
        far.setblocking(False)
        address, _, port = plc.partition(":")
        self.client = ModbusTcpClient(address, port=int(port))
        self.devices = {
            "plc": Entry(driver="modbus", address=plc, settings={"timeout": 30.0}),
            "mem": Entry(driver="file", address=str(memory)),
            "udp": Entry(driver="udp", address=f"127.0.0.1:{far.getsockname()[1]}"),
        }

    def seen(self):
        """Return the registers, the bytes of the file, and the last datagram."""
        with suppress(BlockingIOError):
            while True:
                self.last = self.far.recv(64)
        registers = self.client.read_holding_registers(0, count=2).registers
        return registers, self.memory.read_bytes()[4:8], self.last

    def acts(self):
        wait_for(lambda: self.seen() == ([1000, 1000], b"acts", b"acts"), "commands")

    def is_safe(self):
        wait_for(lambda: self.seen() == ([0, 7], b"safe", b"safe"), "safe values")

    def users(self):
        """Return the ports that are taken."""
        return [
            one for entry in self.devices.values()
            for one in port_claims.users(entry, range(2))
        ]  # fmt: skip


@pytest.fixture(scope="module")
def plc():
    """The address of a Modbus server with registers that stay."""
    with serving(lambda units: ModbusTcpServer(units, address=("127.0.0.1", 0))) as one:
        yield f"127.0.0.1:{one.transport.sockets[0].getsockname()[1]}"


@pytest.fixture
def bus(plc, nodes, tmp_path):
    """A task that acts on all of them; on an agent process."""
    memory = tmp_path / "memory"
    memory.write_bytes(bytes(16))
    nodes.write_module("acts", ACTS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far:
        far.bind(("127.0.0.1", 0))
        bus = Bus(plc, memory, far)
        bus.client.connect()
        nodes.agent_process("arm0", grace=0.5, device=bus.devices)
        yield bus
        bus.client.close()


def start(arm, bus):
    """Spawn the task and turn it on; return its process id."""
    arm.spawn("acts", "acts", text=rmod("acts"), restart="never")
    bus.is_safe()
    arm.on("acts")
    bus.acts()
    return arm.status("acts").tid


def test_orders_and_errors_leave_safe_values(bus, nodes):
    arm = nodes.master("arm0", "arm")
    path = record(arm)
    start(arm, bus)
    arm.off("acts")
    bus.is_safe()
    arm.on("acts")
    bus.acts()
    arm.refused(MethodError, arm.off, "acts", arg="fail")  # it goes to ERROR
    assert arm.status("acts").state == "ERROR"
    bus.is_safe()
    arm.control("acts", "clear")
    arm.on("acts")
    wait_for(lambda: arm.status("acts").state == "ERROR", "a cycle that raises")
    bus.is_safe()
    arm.kill("acts")
    assert bus.users() == []
    log = finish(arm, path)
    (verdict,) = verify(log, ["acts"])
    assert verdict.good, str(verdict)
    assert verdict.cycles


def killed(bus, task, *pids):
    """Kill processes; return when the devices are safe, free, and not guarded."""
    assert len(processes_of(GUARD, str(task))) == 1
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    bus.is_safe()
    wait_for(lambda: task not in {one.pid for one in bus.users()}, "its ports free")
    wait_for(lambda: not processes_of(GUARD, str(task)), "the end of its guard")


def test_whatever_is_killed_the_devices_are_safe(bus, nodes):
    """Each time something else of what runs is killed, and in the end all of it."""
    arm = nodes.master("arm0", "arm")
    task = start(arm, bus)
    os.kill(task, signal.SIGKILL)
    arm.wait_event("TASK_DIED", "acts")
    task = start(arm, bus)  # at once: its ports are free when they are safe
    killed(bus, task, fork_server_of(arm.claimed.agent.rtpu_pid))
    wait_for(lambda: arm.events("FORK_SERVER_DIED"), "what is told")
    arm.kill("acts")
    task, agent = start(arm, bus), nodes.processes["arm0"]
    killed(bus, task, agent.pid)
    arm = again(nodes, bus, agent)
    task = start(arm, bus)
    rtpu, agent = arm.claimed.agent.rtpu_pid, nodes.processes["arm0"]
    killed(bus, task, rtpu)
    rtpu = nodes.wait_restarted("arm0", rtpu).rtpu_pid
    task = start(arm, bus)
    killed(bus, task, agent.pid, rtpu, fork_server_of(rtpu), task)
    again(nodes, bus, agent)  # it cleans up


def again(nodes, bus, agent):
    """Return the master of a new agent in the place of a killed one."""
    agent.wait()
    nodes.forget_session()
    nodes.agent_process("arm0", grace=0.5, device=bus.devices)
    return nodes.master("arm0", "arm")
