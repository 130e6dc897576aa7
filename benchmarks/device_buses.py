"""Devices on CAN and EtherCAT, for what their drivers cost beside the bare library.

A node of CANopen answers over python-can's virtual bus when it is told to. Groups of
J1939 come from memory, at the edge of the kernel's sockets, and slaves of EtherCAT
answer from memory at that of pysoem.
"""

from __future__ import annotations

import socket
from threading import Thread
from typing import TYPE_CHECKING, Any
from unittest import mock

import can

from benchmarks.device_libraries import Case, opened
from pbonet.io.drivers import Entry, Mode, Wait

if TYPE_CHECKING:
    from contextlib import ExitStack

BUS = "bench of canopen"
NODE = 5
IMAGE = 8
"""Bytes of the process image of EtherCAT, in each direction."""


def cases(stack: ExitStack) -> list[Case]:
    """Open the devices, and return what is measured."""
    return [canopen(stack), *process_data(stack), j1939(stack), ethercat(stack)]


def buses(stack: ExitStack, *channels: str) -> list[can.BusABC]:
    """Return ends of virtual buses, which are closed with the stack."""
    found = [can.Bus(channel=one, interface="virtual") for one in channels]
    for one in found:
        stack.callback(one.shutdown)
    return found


def frame(identity: int, data: bytes) -> can.Message:
    """Return a frame."""
    return can.Message(arbitration_id=identity, data=data, is_extended_id=False)


def answer(node: Any, count: int = 1) -> None:  # noqa: ANN401 - a bus of python-can
    """Answer the next requests for objects."""
    for _ in range(count):
        while (asked := node.recv(60.0)).arbitration_id != 0x600 + NODE:
            pass
        data, value = bytes(asked.data), b"\1\2\3\4"
        head, value = (b"\x43", value) if data[0] == 0x40 else (b"\x60", bytes(4))
        node.send(frame(0x580 + NODE, head + data[1:4] + value))


def entry(driver: str, channel: str, *objects: str) -> Entry:
    """Return the node as a device."""
    told = {"objects": list(objects), "unit": NODE, "timeout": 60.0}
    return Entry(
        driver=driver, address=channel, settings={**told, "interface": "virtual"}
    )


def canopen(stack: ExitStack) -> Case:
    """Return the case of one object, with the request for the next value."""
    node, near, far = buses(stack, BUS, f"other {BUS}", f"other {BUS}")
    is_there = Thread(target=answer, args=(node,))
    is_there.start()
    drive = opened(stack, entry("canopen", BUS, "6064:00/32"), Mode.READ)
    is_there.join()
    request = frame(0x600 + NODE, b"\x40\x64\x60" + bytes(5))
    drive.read()  # the first request
    near.send(request)

    def both() -> None:
        answer(node)
        answer(far)

    return Case(
        *("canopen (virtual), one object", both, drive.read),
        lambda: (near.recv(0), near.send(request)),
    )


def process_data(stack: ExitStack) -> list[Case]:
    """Return the cases of one object as process data, in both directions."""
    channels = [f"bench of process data {way}" for way in ("in", "out")]
    nodes = buses(stack, *channels)
    near, far, at_drive = buses(stack, "bare", "bare", channels[1])
    devices: list[Any] = []
    for node, channel, mode in zip(
        nodes, channels, (Mode.READ, Mode.WRITE), strict=True
    ):
        sets = 8 if mode is Mode.READ else 7  # the type, and those of the mapping
        serves = Thread(target=answer, args=(node, sets))
        serves.start()
        one = entry("canopen_pdo", channel, "6064:00/32")
        devices.append(opened(stack, one, mode))
        serves.join()
    sends, takes = frame(0x180 + NODE, bytes(4)), frame(0x200 + NODE, bytes(4))

    def come() -> None:
        nodes[0].send(sends)
        far.send(sends)

    def empty() -> None:
        for end in (far, nodes[1], at_drive):
            while end.recv(0) is not None:
                pass

    return [
        Case(
            *("canopen_pdo (virtual), read", come, devices[0].read),
            lambda: near.recv(0),
        ),
        Case(
            *("canopen_pdo (virtual), write", empty, lambda: devices[1].write([7])),
            lambda: near.send(takes),
        ),
    ]


class Groups:
    """A socket of J1939 that has groups when it is told to."""

    def __init__(self, *_: object) -> None:
        self._there: list[bytes] = []

    def setsockopt(self, *_: object) -> None:
        """Set an option."""

    def bind(self, where: object) -> None:
        """Take an address."""

    def close(self) -> None:
        """Close it."""

    def fileno(self) -> int:
        """Return no descriptor: nothing waits."""
        return -1

    def come(self) -> None:
        """Let a group come."""
        self._there.append(bytes(8))

    def recvmsg(self, *_: object) -> tuple[Any, ...]:
        """Return the group that has come."""
        if not self._there:
            raise BlockingIOError
        return self._there.pop(), [], 0, ("can0", 0, 0xFEF1, 7)


def j1939(stack: ExitStack) -> Case:
    """Return the case of one group."""
    there, plain = Groups(), Groups()
    with mock.patch.object(socket, "socket", return_value=there):
        one = Entry(driver="j1939", address="can0", settings={"source": 3})
        ecu = opened(stack, one, Mode.READ)

    def both() -> None:
        there.come()
        plain.come()

    return Case(
        *("j1939, one group of 8 bytes", both, lambda: ecu.read(1)),
        lambda: plain.recvmsg(1785, 256),
    )


class Slave:
    """A slave of EtherCAT whose inputs are its outputs."""

    name = "slave"

    def __init__(self) -> None:
        self.output = bytes(IMAGE)
        self.state = self.al_status = 0

    @property
    def input(self) -> bytes:
        """What it was sent last."""
        return self.output


class Master:
    """A bus of one slave at the edge of pysoem."""

    expected_wkc = 3
    state = 0

    def __init__(self) -> None:
        self.slaves = [Slave()]

    def open(self, interface: str) -> None:
        """Open the interface."""

    def close(self) -> None:
        """Close it."""

    def config_init(self) -> int:
        """Return how many slaves there are."""
        return len(self.slaves)

    def config_map(self) -> None:
        """Lay out the image."""

    def state_check(self, wanted: int, _microseconds: int) -> int:
        """Return the state in which all slaves are."""
        return wanted

    def write_state(self) -> None:
        """Bring the slaves to a state."""

    def send_processdata(self) -> None:
        """Send the image."""

    def receive_processdata(self, _microseconds: int) -> int:
        """Return how many slaves have taken part in the image."""
        return self.expected_wkc


def ethercat(stack: ExitStack) -> Case:
    """Return the case of an exchange, with what is written before and read after."""
    with mock.patch("pysoem.Master", Master):
        one = Entry(driver="ethercat", address="eth1", settings={"slaves": 1})
        bus = opened(stack, one, Mode.RW, Wait.ALL)
    bare, data = Master(), bytes(IMAGE)

    def ours() -> None:
        bus.write(data)
        bus.exchange()
        bus.read(IMAGE)

    def plain() -> bytes:
        slave = bare.slaves[0]
        slave.output = data
        bare.send_processdata()
        bare.receive_processdata(2000)
        return slave.input

    return Case("ethercat, write, exchange, read", int, ours, plain)
