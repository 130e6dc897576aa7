"""Safe values on a bus, whatever ends: the task, its RTPU process, its agent, or all.

The buses are outside of what is killed: registers of a Modbus server in the test's
process, datagrams to its socket, a file, and terminals to drives and servos.
"""

from __future__ import annotations

import os
import signal
import socket
from contextlib import suppress

import pytest
from device_rigs import Servos
from log_of_real_tasks import finish, record
from modbus_rig import serving
from nodekit import fork_server_of, rmod, svar
from pymodbus.client import ModbusTcpClient
from pymodbus.server import ModbusTcpServer
from scripted_motors import Served
from watching import processes_of, wait_for

from pbonet.config import Entry
from pbonet.errors import MethodError
from pbonet.io.drivers import GUARD, port_claims
from pbonet.testing import verify
from pbonet.xm.net import messages as m

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
    """All of them, and a module that acts on them."""
    memory = tmp_path / "memory"
    memory.write_bytes(bytes(16))
    nodes.write_module("acts", ACTS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far:
        far.bind(("127.0.0.1", 0))
        bus = Bus(plc, memory, far)
        bus.client.connect()
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
    nodes.agent_process("arm0", grace=0.5, device=bus.devices)
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


REFERENCES = """
from typing import Annotated as A

import numpy as np

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Kind(Params):
    broken: A[bool, param("none", "whether they are no numbers")] = False


class References(PortBasedObject[Kind]):
    u: A[Vector, OutVar("U_REF", "2", "none", "for outputs")]
    q: A[float, OutVar("Q_REF", "1", "rad", "for positions")]
    qd: A[float, OutVar("Q^_REF", "1", "rad/s", "for speeds")]
    t: A[float, OutVar("T_REF", "1", "N*m", "for torques")]

    def cycle(self, dt: float) -> None:
        self.u[:] = np.nan if self.params.broken else 1000.0
        self.q = self.qd = self.t = np.nan if self.params.broken else 0.0
"""
AXES = {"position": "Q_REF", "speed": "Q^_REF", "torque": "T_REF"}
"""Modules of drives on CAN, and what they read."""
MEASURED = {"Q_MEZ": "rad", "Q^_MEZ": "rad/s", "T_MEZ": "N*m", "GEAR": "none"}
COUNTED = "READY", "NDOF"
VARIABLE = """
NAME {name}
TYPE {kind}
DESC a variable
UNITS {unit}
NELEM {nelem}
{more}
"""
RMOD = """MODULE {module}
DESC an actuator
{aliases}
INCONST none
OUTCONST {consts}
INVAR {reads}
OUTVAR {writes}
TASKTYPE periodic
FREQ 100
{critical}
LOCAL
{local}
EOF
"""
LOCAL = {
    "axes": "DEVICE {tag}\nNODES 5\nCOUNTS 4096\nRATED 0.5\nBEAT 10\n",
    "servos": "DEVICE servos\nZERO -3.14159265\nHOLD no\nSILENT 60\nBEAT 2.54\n",
    "outputs": "DEVICE plc\nPORT 2\nSCALE 1.0\nSAFE 3 5\nWAIT none\n",
}
REGISTERS = [[98, 1], [64, 1], [116, 4], [126, 2], [128, 4], [132, 4]]
QUICK_STOP = 2


def axes_rmod(module, reads, tag, local):
    """Return the RMOD of axes whose outputs have names of their own."""
    names = (*MEASURED, *COUNTED)
    return RMOD.format(
        module=module,
        aliases="\n".join(f"SVARALIAS {one}={one}{tag}" for one in names),
        consts="NDOF GEAR",
        reads=reads,
        writes="Q_MEZ Q^_MEZ T_MEZ READY",
        critical="CRITICAL",
        local=local + ("LIMIT 10\n" if module == "can_torque" else "SPEED 1\n"),
    )


def table():
    """Return the variables of all actuators."""
    rows = [("U_REF", "double", "none", 2), ("U_OUT", "double", "none", 2)]
    rows += [("Q_REF", "double", "rad", 1), ("Q^_REF", "double", "rad/s", 1)]
    rows += [("T_REF", "double", "N*m", 1)]
    for tag in (*AXES, "servos"):
        rows += [(f"{one}{tag}", "double", unit, 1) for one, unit in MEASURED.items()]
        rows += [(f"{one}{tag}", "int", "none", 1) for one in COUNTED]
    text = "".join(
        VARIABLE.format(
            name=name,
            kind=kind,
            unit=unit,
            nelem=nelem,
            more="FINITE no" if name.endswith("_REF") else "",
        )
        for name, kind, unit, nelem in rows
    )
    return svar().replace("\nEOF\n", f"{text}\nEOF\n")


class Actuators:
    """All actuator modules of the library, and one of a user, on an agent process.

    Args:
        bus: Where the module of a user acts, and the outputs.
        drives: Three drives on CAN.
        servos: A servo on a line.
        nodes: The kit.
    """

    def __init__(self, bus, drives, servos, nodes):
        self.bus, self.drives, self.servos, self.nodes = bus, drives, servos, nodes
        self.rmods = {"acts": rmod("acts")}
        self.devices = dict(bus.devices)
        for (tag, reads), drive in zip(AXES.items(), drives, strict=True):
            self.devices[tag] = Entry(
                driver="can",
                address=drive.bus.path,
                settings={"interface": "slcan"},
            )
            local = LOCAL["axes"].format(tag=tag)
            self.rmods[tag] = axes_rmod(f"can_{tag}", reads, tag, local)
        self.devices["servos"] = Entry(
            driver="dynamixel",
            address=servos.path,
            settings={"servos": [1], "registers": REGISTERS, "timeout": 30.0},
        )
        self.rmods["servos"] = axes_rmod(
            "dynamixel", "Q_REF", "servos", LOCAL["servos"]
        )
        self.rmods["outputs"] = RMOD.format(
            module="linear_actuator",
            aliases="SVARALIAS U=U_REF\nSVARALIAS Y=U_OUT",
            consts="none",
            reads="U",
            writes="Y",
            critical="CRITICAL",
            local=LOCAL["outputs"],
        )
        self.run_agent()

    def run_agent(self):
        """Run an agent, which may take the place of a killed one; have a master."""
        self.nodes.agent_process("arm0", grace=0.5, device=self.devices)
        self.arm = self.nodes.master("arm0", "arm", table=False)
        self.arm.open_table(table())

    def run_references(self):
        """Have a task that writes what the actuators read."""
        text = rmod("references", out="", freq=100)
        text = text.replace("OUTVAR none", "OUTVAR U_REF Q_REF Q^_REF T_REF")
        self.arm.spawn("references", "references", text=text, restart="never")
        self.arm.on("references")

    def start(self):
        """Spawn all and turn them on; return the process ids of those with devices."""
        wait_for(lambda: "ON" not in self.states(), "the end of what was")
        self.run_references()
        for task, text in self.rmods.items():
            self.arm.spawn(task, task, text=text, restart="never")
        self.are_safe()
        for task in self.rmods:
            self.arm.on(task)
        self.act()
        return [self.arm.status(task).tid for task in self.rmods]

    def states(self):
        return [one.state for one in self.arm.status().values()]

    def lose_references(self):
        os.kill(self.arm.status("references").tid, signal.SIGKILL)
        wait_for(lambda: self.arm.status("references").state != "ON", "its end")

    def act(self):
        """Wait until all act; one for which the machine stood still begins again."""

        def there():
            for name, one in self.arm.status().items():
                if one.state == "ERROR":
                    self.arm.control(name, "clear")
                    self.arm.on(name)
            return (
                self.bus.seen() == ([1000, 1000], b"acts", b"acts")
                and self.outputs() == [1000, 1000]
                and [one.state for one in self.drives] == ["enabled"] * 3
                and self.servos.memory[1][64] == 1
            )

        wait_for(there, "commands")

    def outputs(self):
        return self.bus.client.read_holding_registers(2, count=2).registers

    def stand(self):
        """Wait until what reads the references has its safe values on the buses."""
        wait_for(lambda: self.outputs() == [3, 5], "safe outputs")
        wait_for(
            lambda: all(one.control in {0, QUICK_STOP} for one in self.drives),
            "a quick stop on each bus",
        )

    def are_safe(self):
        """Wait until all have their safe values on the buses."""
        self.stand()
        wait_for(lambda: self.servos.memory[1][64] == 0, "a servo without torque")
        self.bus.is_safe()

    def users(self):
        return [
            one
            for entry in self.devices.values()
            for one in port_claims.users(entry, range(6))
        ]

    def killed(self, tasks, *pids):
        """Kill processes; return when the devices are safe, free, and not guarded."""
        assert all(len(processes_of(GUARD, str(one))) == 1 for one in tasks)
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        self.are_safe()
        wait_for(lambda: not self.users(), "free ports")
        for task in tasks:
            wait_for(lambda one=task: not processes_of(GUARD, str(one)), "its guard")

    def agent_again(self, agent):
        """Have a new agent in the place of a killed one."""
        agent.wait()
        self.nodes.forget_session()
        self.run_agent()


@pytest.fixture
def actuators(bus, nodes):
    """All of them."""
    nodes.write_module("references", REFERENCES)
    drives, servos = Served(5, 5, 5), Servos(1)
    servos.memory[1][132:136] = (2048).to_bytes(4, "little")
    try:
        yield Actuators(bus, drives.drives, servos, nodes)
    finally:
        servos.close()
        drives.close()


def test_every_actuator_is_safe_whatever_is_lost(actuators):
    """Each time something else is lost, and in the end all of it at once."""
    it = actuators
    nodes = it.nodes
    it.start()
    it.lose_references()
    it.stand()
    assert it.servos.memory[1][64], "without a reference servos stay where they are"
    it.run_references()
    it.act()
    it.arm.ask(m.Set(task="references", name="broken", value="yes"))
    wait_for(lambda: it.states().count("ERROR") == 5, "ERROR of all that read them")
    it.stand()
    it.arm.ask(m.Set(task="references", name="broken", value="no"))
    it.act()
    for task in (*it.rmods, "references"):
        it.arm.kill(task)
    it.are_safe()
    assert it.users() == []
    tasks = it.start()
    it.killed(tasks, *tasks)
    it.lose_references()
    tasks = it.start()  # at once: the ports are free when they are safe
    it.killed(tasks, fork_server_of(it.arm.claimed.agent.rtpu_pid))
    wait_for(lambda: it.arm.events("FORK_SERVER_DIED"), "what is told")
    tasks, agent = it.start(), nodes.processes["arm0"]
    it.killed(tasks, agent.pid)
    it.agent_again(agent)
    tasks, agent = it.start(), nodes.processes["arm0"]
    rtpu = it.arm.claimed.agent.rtpu_pid
    it.killed(tasks, rtpu)
    rtpu = nodes.wait_restarted("arm0", rtpu).rtpu_pid
    tasks = it.start()
    it.killed(tasks, agent.pid, rtpu, fork_server_of(rtpu), *tasks)
    it.agent_again(agent)  # it cleans up
