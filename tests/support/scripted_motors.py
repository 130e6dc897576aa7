"""Motors that a test makes up: servos by their registers, and drives on a CAN bus.

`Servos` is a driver, a device with ports that does not wait. A `ScriptedDrive` is on
any bus of python-can, or on that of an `Adapter`, which other processes reach, too.
"""

from __future__ import annotations

import os
import select
import struct
import threading
import time
import tty
from contextlib import suppress
from typing import ClassVar, NamedTuple

import can

from pbonet.errors import DeviceError
from pbonet.io.drivers import PortDevice, Wait

SIZES = 1, 1, 4, 2, 4, 4
"""Bytes of the registers 98, 64, 116, 126, 128 and 132."""
WATCHDOG, TORQUE, GOAL, CURRENT, SPEED, PLACE = range(6)


class Servos(PortDevice):
    """Two servos of each address; a reading is there a call after it was asked for."""

    kind = "RCB"
    waits = frozenset({Wait.ALL, Wait.NONE})
    tables: ClassVar[dict[str, list[list[int]]]] = {}
    silent = False

    def connect(self):
        self.table = self.tables[self.entry.address]
        self.asked = False

    def disconnect(self):
        pass

    def port_bits(self, port):
        return 8 * SIZES[port // 2]

    def read_ports(self):
        asked, self.asked = self.asked, True
        if not asked or Servos.silent:
            return None
        self.asked = False
        places = range(self.opening.start, self.opening.end + 1)
        return [self.table[port // 2][port % 2] for port in places]

    def write_ports(self, values):
        for port, value in enumerate(values, self.opening.start):
            register, servo = divmod(port, 2)
            if register == GOAL and self.table[WATCHDOG][servo] == 255:
                raise DeviceError("a servo refuses the request", where="watchdog")
            self.table[register][servo] = value
            if register == GOAL and self.table[TORQUE][servo]:
                self.table[PLACE][servo] = value


class Row(NamedTuple):
    """A transition of the state machine (CiA 402-2, table of transitions)."""

    state: str
    commands: str
    then: str


COMMANDS = {
    # bits of the control word that count: 7 fault reset, 3 enable operation, 2 quick
    # stop, 1 enable voltage, 0 switch on
    "shutdown": (0b1000_0111, 0b0000_0110),
    "switch on": (0b1000_1111, 0b0000_0111),
    "disable voltage": (0b1000_0010, 0b0000_0000),
    "quick stop": (0b1000_0110, 0b0000_0010),
    "enable operation": (0b1000_1111, 0b0000_1111),
}
TABLE = [
    Row("switch on disabled", "shutdown", "ready"),  # 2
    Row("ready", "switch on", "switched on"),  # 3
    Row("switched on", "enable operation", "enabled"),  # 4
    Row("enabled", "switch on", "switched on"),  # 5
    Row("switched on", "shutdown", "ready"),  # 6
    Row("ready", "quick stop", "switch on disabled"),  # 7
    Row("ready", "disable voltage", "switch on disabled"),  # 7
    Row("enabled", "shutdown", "ready"),  # 8
    Row("enabled", "disable voltage", "switch on disabled"),  # 9
    Row("switched on", "quick stop", "switch on disabled"),  # 10
    Row("switched on", "disable voltage", "switch on disabled"),  # 10
    Row("enabled", "quick stop", "quick stop active"),  # 11
    Row("quick stop active", "disable voltage", "switch on disabled"),  # 12
]
WORDS = {
    # with bits that do not count for the state
    "not ready": 0b0000_0000_0000,
    "switch on disabled": 0b0010_0101_0000,
    "ready": 0b0010_0011_0001,
    "switched on": 0b0010_0011_0011,
    "enabled": 0b0110_0011_0111,
    "quick stop active": 0b0010_0001_0111,
    "fault": 0b0010_0011_1000,
}
OBJECTS = {0x1016, 0x1017, 0x6007, 0x605A, 0x6060, 0x60C2}
OBJECTS |= {0x1400, 0x1600, 0x1800, 0x1A00, 0x1801, 0x1A01}


class ScriptedDrive:
    """A drive: objects, heartbeats, process data as they are mapped, and the table."""

    def __init__(self, bus, node):
        self.bus = bus
        self.node, self.objects, self.missing = node, {}, {0x60C2}
        self.state, self.nmt, self.control = "switch on disabled", 0x7F, 0
        self.passed = [self.state]
        self.values = {0x6064: 1000, 0x606C: 0, 0x6077: 0}
        self.heard, self.beaten, self.silent = None, 0, False
        self.stays_in_fault, self.fails_in = False, ""
        self.targets = {}

    def go(self, state):
        if state != self.state:
            self.passed.append(state)
        self.state = state
        if state == self.fails_in:
            self.fail(0x8611)

    def send(self, identity, data):
        if not self.silent:
            self.bus.send(
                can.Message(arbitration_id=identity, data=data, is_extended_id=False)
            )

    def serve(self, now):
        """Take what was sent, and send what is due."""
        while (one := self.bus.recv(0)) is not None:
            self.take(one.arbitration_id, bytes(one.data), now)
        self.watch(now)
        every = self.objects.get((0x1017, 0), 0) * 1_000_000
        if every and now - self.beaten >= every:
            self.beaten = now
            self.send(0x700 + self.node, bytes((self.nmt,)))
        if self.nmt == 5:
            self.move()
            for index in (0x1800, 0x1801):
                self.send_data(index)

    def take(self, identity, data, now):
        if identity == 0 and data[1] in {0, self.node}:
            self.nmt = {1: 5, 0x80: 0x7F, 2: 4}[data[0]]
        elif identity == 0x600 + self.node:
            self.write(data)
        elif identity == self.objects.get((0x1400, 1)) and self.nmt == 5:
            self.process(data)
        elif identity == 0x700 + (self.objects.get((0x1016, 1), 0) >> 16):
            self.heard = now

    def write(self, data):
        """Answer a request that writes an object (SDO download, expedited)."""
        kind, index, sub = struct.unpack_from("<BHB", data)
        assert kind & 0xE3 == 0x23
        size = 4 - (kind >> 2 & 3)
        assert not any(data[4 + size :])
        head = struct.pack("<HB", index, sub)
        if index not in OBJECTS - self.missing:
            answer = b"\x80" + head + struct.pack("<I", 0x06020000)
        elif index in {0x1600, 0x1A00, 0x1A01} and (
            self.nmt != 0x7F or not self.objects[index - 0x200, 1] & 0x80000000
        ):
            answer = b"\x80" + head + struct.pack("<I", 0x08000022)
        else:
            self.objects[index, sub] = int.from_bytes(data[4 : 4 + size], "little")
            answer = b"\x60" + head + bytes(4)
        self.send(0x580 + self.node, answer)

    def mapped(self, index):
        """Return what process data consist of: objects and bytes."""
        for k in range(1, self.objects[index, 0] + 1):
            entry = self.objects[index, k]
            yield entry >> 16, (entry & 0xFF) // 8

    def process(self, data):
        found, at = {}, 0
        for index, size in self.mapped(0x1600):
            value = int.from_bytes(data[at : at + size], "little", signed=size > 1)
            found[index], at = value, at + size
        assert at == len(data)
        before, self.control = self.control, found.pop(0x6040) & 0xFFFF
        self.targets = found
        if self.state == "fault":
            rises = self.control & 0x80 and not before & 0x80
            if rises and not self.stays_in_fault:
                self.go("switch on disabled")  # 15
            return
        for state, command, then in TABLE:
            mask, value = COMMANDS[command]
            if state == self.state and self.control & mask == value:
                self.go(then)
                break

    def watch(self, now):
        """Stop quickly when the task is silent, as its objects say."""
        entry = self.objects.get((0x1016, 1), 0)
        if entry and self.heard and now - self.heard > (entry & 0xFFFF) * 1_000_000:
            assert self.objects[0x6007, 0] == 3
            if self.state == "enabled":
                self.go("quick stop active")

    def move(self):
        if self.state != "enabled":
            self.values[0x606C] = self.values[0x6077] = 0
            return
        for index, value in self.targets.items():
            shown = {0x607A: 0x6064, 0x60FF: 0x606C, 0x6071: 0x6077}[index]
            self.values[shown] = value

    def send_data(self, index):
        mode = self.objects.get((0x6060, 0), 0)
        shown = {**self.values, 0x6041: WORDS[self.state], 0x6061: mode}
        data = b"".join(
            (shown[one] & (1 << 8 * size) - 1).to_bytes(size, "little")
            for one, size in self.mapped(index + 0x200)
        )
        self.send(self.objects[index, 1] & 0x7FF, data)

    def fail(self, code):
        self.go("fault")
        self.send(0x80 + self.node, struct.pack("<HB5x", code, 1))


class Adapter:
    """A CAN adapter at the other end of a terminal (slcan); its bus is the test's.

    It has the methods of a bus of python-can.
    """

    def __init__(self):
        self.fd, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.fd, False)
        self.path = os.ttyname(self._slave)
        self._held, self._rest, self._is_open = b"", b"", False

    def send(self, message):
        """Send a frame; where who has opened it does not read, that is dropped."""
        if not self._is_open or (self._rest and not self._give(self._rest)):
            return
        head = f"t{message.arbitration_id:03X}{len(message.data)}"
        self._give(f"{head}{message.data.hex()}\r".encode())

    def _give(self, line):
        """Write a line whole; return False if there is no room for all of it now."""
        with suppress(BlockingIOError):
            line = line[os.write(self.fd, line) :]
        self._rest = line
        return not line

    def recv(self, _seconds):
        """Return the next frame that has come, or None."""
        with suppress(BlockingIOError):
            self._held += os.read(self.fd, 65536)
        while b"\r" in self._held:
            line, self._held = self._held.split(b"\r", 1)
            kind, rest = line[:1], line[1:].decode()
            if kind == b"t":
                data = bytes.fromhex(rest[4:])
                return can.Message(
                    arbitration_id=int(rest[:3], 16), data=data, is_extended_id=False
                )
            self._is_open = {b"O": True, b"C": False}[kind]
        return None

    def shutdown(self):
        os.close(self.fd)
        os.close(self._slave)


class Served:
    """Drives, each on an adapter of its own, served by a thread.

    Args:
        nodes: Their numbers.
    """

    def __init__(self, *nodes):
        self.drives = [ScriptedDrive(Adapter(), node) for node in nodes]
        self._stop = os.pipe()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        ends = [self._stop[0], *(one.bus.fd for one in self.drives)]
        while self._stop[0] not in select.select(ends, [], [], 0.01)[0]:
            for one in self.drives:
                one.serve(time.monotonic_ns())

    def close(self):
        os.write(self._stop[1], b"x")
        self._thread.join()
        for fd in self._stop:
            os.close(fd)
        for one in self.drives:
            one.bus.shutdown()
