"""Devices that a test makes up, each at the edge of its library or of the kernel.

A rig has the device's entry, the mode in which it is opened, and what can happen to it.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import threading
import tty

import can
import gpiod
import pysoem
import spidev
from msgspec.structs import replace
from watching import wait_for

from pbonet.io.drivers import (
    Entry,
    Group,
    Mode,
    camera_driver,
    iio_buffer_driver,
    joystick_driver,
)


def gone(*_):
    raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))


SOCKET = socket.socket


class Rig:
    """A device of a driver; the defaults fit ports that are read."""

    mode = Mode.READ
    library = extra = ""
    """The package without which it cannot be opened."""
    ports = 1
    """How many it has."""
    wrong = None
    """A mode that it does not have."""
    lost = "No such device"
    """What is told when it is lost."""
    safe = unsafe = None
    """Values that it is left with, and others, where it is written."""
    never_safe = ()
    """Values that cannot be safe, each with what is told."""

    def __init__(self, monkeypatch, tmp_path):
        self.patch, self.folder = monkeypatch, tmp_path

    def missing(self):
        """Return the entry of one that is not there."""
        return replace(self.entry(), address=str(self.folder / "none"))

    def use(self, device):
        """Return what the device gives."""
        return device.read()

    def outputs(self):
        """Return what it was written last, as `write` takes it."""
        raise NotImplementedError

    def close(self):
        """Leave nothing behind."""


def entry(driver, address, first=0, ports=0, **settings):
    return Entry(
        driver=driver, address=str(address), first=first, ports=ports, settings=settings
    )


class Lines:
    """What a chip gives for requested lines; edges come by a pipe."""

    def __init__(self, chip, config, size):
        self.chip, self.config, self.size = chip, config, size
        self.fd, self._there = os.pipe()
        self.edges, self.number = [], 0
        self._drive()

    def get_values(self, lines):
        self.chip.check()
        return [gpiod.line.Value(self.chip.values.get(k, [0])[-1]) for k in lines]

    def set_values(self, values):
        self.chip.check()
        assert set(values) <= set(self.config)
        for line, value in values.items():
            self.chip.values.setdefault(line, []).append(value.value)

    def reconfigure_lines(self, config):
        assert set(config) == set(self.config)
        self.config = config
        self._drive()

    def _drive(self):
        for line, one in self.config.items():
            assert isinstance(one, gpiod.LineSettings)
            if one.direction == gpiod.line.Direction.OUTPUT:
                self.chip.values.setdefault(line, []).append(one.output_value.value)

    def edge(self, line, rising, stamp_ns):
        self.number += 1
        kind = gpiod.EdgeEvent.Type.RISING_EDGE if rising else 2
        self.edges.append(gpiod.EdgeEvent(kind, stamp_ns, line, self.number, 1))
        del self.edges[: -self.size]
        os.write(self._there, b"x")

    def wait_edge_events(self, seconds):
        assert seconds == 0
        self.chip.check()
        return bool(self.edges)

    def read_edge_events(self, limit):
        found, self.edges = self.edges[:limit], self.edges[limit:]
        return found

    def release(self):
        self.chip.requests.remove(self)
        os.close(self.fd)
        os.close(self._there)


class Chip:
    """A chip of eight lines at the edge of gpiod."""

    num_lines = 8

    def __init__(self, path):
        self.path, self.values, self.requests, self.lost = str(path), {}, [], False

    def __call__(self, path):
        if path != self.path:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def get_info(self):
        return self

    def check(self):
        if self.lost:
            gone()

    def request_lines(self, config, consumer, event_buffer_size=16):
        assert consumer == "pbonet x"
        used = {line for one in self.requests for line in one.config}
        if used & set(config):
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        self.requests.append(Lines(self, config, event_buffer_size))
        return self.requests[-1]


class Gpio(Rig):
    library, extra = "gpiod", "gpio"
    ports = 6
    driver = "gpio"
    safe, unsafe = [1], [0]
    never_safe = [([1, 1], "expected 1, got 2"), ([2], "0 to 1, got 2")]  # noqa: RUF012

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.chip = Chip(tmp_path / "gpiochip0")
        monkeypatch.setattr(gpiod, "Chip", self.chip)

    def entry(self, **settings):
        return entry(self.driver, self.chip.path, first=2, **settings)

    def prepare(self):
        self.chip.values = {3: [1]}

    def lose(self):
        self.chip.lost = True

    def outputs(self):
        return self.chip.values[2][-1:]


class GpioEdges(Gpio):
    driver = "gpio_edges"
    wrong = Mode.RW
    safe = unsafe = None

    def prepare(self):
        self.chip.requests[0].edge(3, True, 7)

    def use(self, device):
        return device.read(1)


class Servos:
    """Servos that answer as they should, at the other end of a terminal.

    It has parsing and a checksum of its own, by the protocol's rules.
    """

    def __init__(self, *numbers):
        self.memory = {number: bytearray(256) for number in numbers}
        self.errors = dict.fromkeys(numbers, 0)
        self.before, self.asked = b"", []
        self.fd, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        os.close(slave)
        self._stop = os.pipe()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def silence(self):
        """Answer no more."""
        os.write(self._stop[1], b"x")
        self._thread.join()

    def close(self):
        if self.fd >= 0:
            self.silence()
            for fd in (self.fd, *self._stop):
                os.close(fd)
            self.fd = -1

    @staticmethod
    def crc(data):
        value = 0
        for bit in (byte >> (7 - k) & 1 for byte in data for k in range(8)):
            value = value << 1 ^ (0x8005 if (value >> 15) ^ bit else 0)
            value &= 0xFFFF
        return value.to_bytes(2, "little")

    def framed(self, number, body):
        body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        head = b"\xff\xff\xfd\0" + bytes((number,))
        whole = head + (len(body) + 2).to_bytes(2, "little") + body
        return whole + self.crc(whole)

    def _serve(self):
        data = b""
        while self._stop[0] not in select.select([self.fd, self._stop[0]], [], [])[0]:
            try:
                data += os.read(self.fd, 999)
            except OSError:  # no end is open now
                select.select([self._stop[0]], [], [], 0.001)
                continue
            while len(data) > 7 and len(data) >= (
                end := 7 + int.from_bytes(data[5:7], "little")
            ):
                one, data = data[:end], data[end:]
                assert one[-2:] == self.crc(one[:-2])
                body = one[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
                os.write(self.fd, self.before + self._answer(one[4], *body))

    def _answer(self, number, instruction, *values):
        self.asked.append(instruction)
        if instruction in {1, 8}:
            given = {1: b"\x06\x04\x2d", 8: b""}[instruction]
            if instruction == 8:
                self.errors[number] = 0
            return self._status(number, given) if number in self.memory else b""
        at, size = (int.from_bytes(values[k : k + 2], "little") for k in (0, 2))
        rest = bytes(values[4:])
        if instruction == 0x83:
            for k in range(0, len(rest), size + 1):
                if rest[k] in self.memory:
                    self.memory[rest[k]][at : at + size] = rest[k + 1 : k + 1 + size]
            return b""
        answers = b""
        for one in rest:
            if one not in self.memory:
                break  # those behind it wait for it
            answers += self._status(one, bytes(self.memory[one][at : at + size]))
        return answers

    def _status(self, number, values):
        return self.framed(number, bytes((0x55, self.errors[number])) + values)


class Dynamixel(Rig):
    ports = 6
    lost = ""
    safe, unsafe = [0], [1]
    never_safe = [([0, 0], "expected 1, got 2"), ([-1], "0 to 255, got -1")]  # noqa: RUF012

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.servos = Servos(1, 7)

    def entry(self, **settings):
        settings = {"servos": [1, 7], "timeout": 30.0, **settings}
        return entry("dynamixel", self.servos.path, **settings)

    def outputs(self):
        return [self.servos.memory[1][64]]

    def prepare(self):
        self.servos.memory[7][64] = 1

    def lose(self):
        self.servos.close()

    def close(self):
        self.servos.close()


class Spi(Rig):
    """A bus at the edge of spidev; what is read is what was written before."""

    library, extra = "spidev", "spi"
    mode = Mode.RW
    lost = "Cannot send"
    safe, unsafe = b"\0\7", b"\1\1"
    never_safe = [(b"", "expected 1 to 4096 bytes"), (bytes(4097), "got 4097")]  # noqa: RUF012

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.log, self.error = [], 0
        self.refused = ()
        monkeypatch.setattr(spidev, "SpiDev", lambda: self)

    def __setattr__(self, name, value):
        if name in {"mode", "max_speed_hz", "lsbfirst", "cshigh"}:
            if name in self.refused:
                raise OSError(errno.EINVAL, "Invalid argument")
            self.log.append((name, value))
        else:
            super().__setattr__(name, value)

    def entry(self, **settings):
        return entry("spi", self.folder / "spidev0.0", **settings)

    def open_path(self, path):
        if path != self.entry().address:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        self.log.append("open")
        self.before = b""

    def xfer2(self, values):
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        self.log.append(bytes(values))
        found, self.before = self.before[: len(values)], bytes(values)
        return list(found.ljust(len(values), b"\xff"))

    def prepare(self):
        pass

    def outputs(self):
        return self.before

    def lose(self):
        self.error = errno.ESHUTDOWN

    def use(self, device):
        return device.transfer(b"ab")

    def close(self):
        self.log.append("closed")


class IioBuffer(Rig):
    """A folder of plain files and a pipe, in place of sysfs and the device file."""

    ports = 3
    wrong = Mode.WRITE
    lost = "the buffer ended"
    FILES = {  # noqa: RUF012
        "voltage0": ("le:s12/16>>4", 0),
        "voltage2": ("be:u24/32>>8", 2),
        "voltage10": ("le:u8/8>>0", 1),
        "timestamp": ("le:s64/64>>0", 3),
    }

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.path = tmp_path / "sys" / "iio:device0"
        for name, (kind, index) in self.FILES.items():
            self.set(f"scan_elements/in_{name}_type", f"{kind}\n")
            self.set(f"scan_elements/in_{name}_index", f"{index}\n")
            self.set(f"scan_elements/in_{name}_en", "0\n")
        for name in ("buffer/length", "buffer/enable", "current_timestamp_clock"):
            self.set(name, "0\n")
        self.set("trigger/current_trigger", "\n")
        (tmp_path / "dev").mkdir()
        os.mkfifo(tmp_path / "dev" / "iio:device0")
        self.fd = os.open(tmp_path / "dev" / "iio:device0", os.O_RDWR)
        monkeypatch.setattr(iio_buffer_driver, "DEVICE_FILES", str(tmp_path / "dev"))

    def set(self, name, text):
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def entry(self, **settings):
        return entry("iio_buffer", self.path, **settings)

    def prepare(self):
        os.write(self.fd, bytes(16))

    def use(self, device):
        return device.read(1)

    def lose(self):
        os.close(self.fd)
        self.fd = -1

    def close(self):
        if self.fd >= 0:
            os.close(self.fd)


class Joystick(Rig):
    """A pipe for the kernel's events, and the answers of the kernel."""

    ports = 4
    wrong = Mode.RW
    lost = "no events any more"

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.path = tmp_path / "event7"
        self.axes = {0: (128, 0, 255), 1: (0, -100, 100)}
        self.keys = set()
        monkeypatch.setattr(joystick_driver, "ioctl", self.ioctl)
        self.plug()

    def entry(self, **settings):
        settings = {"axes": [0, 1], "buttons": [304, 305], **settings}
        return entry("joystick", self.path, **settings)

    def plug(self):
        os.mkfifo(self.path)
        self.fd = os.open(self.path, os.O_RDWR | os.O_NONBLOCK)

    def lose(self):
        os.close(self.fd)
        self.fd = -1
        self.path.unlink()

    def close(self):
        if self.fd >= 0:
            self.lose()

    def ioctl(self, _fd, request, room):
        if request == joystick_driver.GET_KEYS:
            table = bytearray(room)
            for code in self.keys:
                table[code // 8] |= 1 << code % 8
            return bytes(table)
        code = (request & 0xFF) - 0x40
        assert request == joystick_driver.get_axis(code)
        return joystick_driver.ABSINFO.pack(*self.axes.get(code, (0, 0, 0)), 0, 0, 0)

    def send(self, *events):
        data = (joystick_driver.EVENT.pack(0, 0, *event) for event in events)
        os.write(self.fd, b"".join(data))

    def prepare(self):
        self.send((joystick_driver.ABS, 1, 50))


class Node:
    """A node of CANopen at the other end of a virtual bus."""

    def __init__(self, number):
        self.number, self.objects = number, {(0x1000, 0): bytes(4)}
        self.aborts, self.asked, self.commands = {}, [], []
        self.bus = can.Bus("bus of a test", interface="virtual")
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def close(self):
        self._ends.set()
        self.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
        self._thread.join()
        self.bus.shutdown()

    @staticmethod
    def send(message):
        with can.Bus("bus of a test", interface="virtual") as other:
            other.send(message)

    def _serve(self):
        while not self._ends.is_set():
            one = self.bus.recv()
            if one.arbitration_id == 0:
                self.commands.append(bytes(one.data))
            if one.arbitration_id == 0x600 + self.number:
                data = self._answer(bytes(one.data))
                self.bus.send(
                    can.Message(
                        arbitration_id=0x580 + self.number,
                        data=data,
                        is_extended_id=False,
                    )
                )

    def _answer(self, data):
        place = int.from_bytes(data[1:3], "little"), data[3]
        self.asked.append((data[0], *place))
        code = self.aborts.get(place, 0x06020000 if place not in self.objects else 0)
        if code:
            return b"\x80" + data[1:4] + code.to_bytes(4, "little")
        size = len(self.objects[place])
        if data[0] == 0x40:
            head = 0x43 | (4 - size) << 2 if size <= 4 else 0x41
            return bytes((head,)) + data[1:4] + self.objects[place][:4].ljust(4, b"\0")
        assert data[0] == 0x23 | (4 - size) << 2
        self.objects[place] = data[4 : 4 + size]
        return b"\x60" + data[1:4] + bytes(4)


class Canopen(Rig):
    library = extra = "can"
    ports = 2
    lost = "bus-off"
    safe, unsafe, never_safe = [6], [15], [([6, 6], "expected 1, got 2")]

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.node = Node(5)
        self.node.objects |= {(0x6041, 0): b"\x37\x02", (0x607A, 0): b"\xff" * 4}

    def entry(self, **settings):
        objects = ["6041:00/16", "607A:00/32"]
        settings = {"objects": objects, "unit": 5, "timeout": 30.0} | settings
        settings = {"interface": "virtual", **settings}
        return entry("canopen", "bus of a test", **settings)

    def missing(self):
        return self.entry(unit=6, timeout=0.02)

    def prepare(self):
        pass

    def outputs(self):
        return [int.from_bytes(self.node.objects[0x6041, 0], "little")]

    def lose(self):
        self.node.send(can.Message(arbitration_id=0x40, is_error_frame=True))

    def close(self):
        self.node.close()


STATUS, PLACE, SPEED, MODE = (0x6041, 0), (0x6064, 0), (0x606C, 0), (0x6061, 0)
WORD, GOAL = (0x6040, 0), (0x607A, 0)
SIZES = {STATUS: 2, PLACE: 4, SPEED: 4, MODE: 1, WORD: 2, GOAL: 4}
"""Objects of a drive (CiA 402), and their bytes."""
DRIVE_OBJECTS = [f"{at:04X}:{sub:02X}/{8 * size}" for (at, sub), size in SIZES.items()]


class Drive(Node):
    """Maps its objects into PDOs as it is told, and has them while operational."""

    def __init__(self, number):
        super().__init__(number)
        self.objects |= {place: bytes(size) for place, size in SIZES.items()}
        for k in range(4):
            for kind in (0x1400, 0x1800):
                self.objects |= {
                    (kind + k, 1): bytes(4),
                    (kind + k, 2): bytes(1),
                    (kind + k, 5): bytes(2),
                    (kind + 0x200 + k, 0): bytes(1),
                }
                for i in range(1, 9):
                    self.objects[kind + 0x200 + k, i] = bytes(4)
        self.heard = can.Bus("bus of a test", interface="virtual")

    def close(self):
        super().close()
        self.heard.shutdown()

    def number_at(self, at, sub):
        return int.from_bytes(self.objects[at, sub], "little")

    def _answer(self, data):
        if data[1:3] in {b"\0\x16", b"\0\x1a"} and data[0] != 0x40:
            assert self.commands[-1][0] == 0x80, "only a node that stands is mapped"
        return super()._answer(data)

    def pdos(self, kind):
        """Return identity and objects of each PDO that exists."""
        for k in range(4):
            identity = self.number_at(kind + k, 1)
            count = self.number_at(kind + 0x200 + k, 0)
            if identity and not identity >> 31:
                rows = [
                    self.number_at(kind + 0x200 + k, i) for i in range(1, count + 1)
                ]
                yield identity, [(row >> 16, row >> 8 & 0xFF) for row in rows]

    def tell(self):
        """Send what is mapped to be sent, when it is operational."""
        self.must_be_operational()
        for identity, places in self.pdos(0x1800):
            data = b"".join(self.objects[place] for place in places)
            one = can.Message(arbitration_id=identity, data=data, is_extended_id=False)
            self.send(one)

    def must_be_operational(self):
        wait_for(lambda: self.commands and self.commands[-1][0] == 1, "operational")

    def take(self):
        """Take over what came for it since the last call."""
        mapped = dict(self.pdos(0x1400))
        while (one := self.heard.recv(0)) is not None:
            rest = bytes(one.data)
            for place in mapped.get(one.arbitration_id, ()):
                self.objects[place] = rest[: SIZES[place]]
                rest = rest[SIZES[place] :]

    def put(self, **numbers):
        for name, number in numbers.items():
            place = globals()[name.upper()]
            self.objects[place] = number.to_bytes(SIZES[place], "little", signed=True)


class CanopenPdo(Canopen):
    safe, unsafe, never_safe = [6], [15], [([6, 6], "expected 1, got 2")]

    def __init__(self, monkeypatch, tmp_path):
        Rig.__init__(self, monkeypatch, tmp_path)
        self.node = Drive(5)

    def entry(self, **settings):
        settings = {"objects": ["6040:00/16", "607A:00/32"], **settings}
        return replace(super().entry(**settings), driver="canopen_pdo")

    def use(self, device):
        """Have the node send while the device waits, and return what came."""
        take = type(device)._take

        def take_and_tell(one):
            take(one)
            self.node.tell()

        with self.patch.context() as patch:
            patch.setattr(type(device), "_take", take_and_tell)
            return device.read()

    def outputs(self):
        self.node.take()
        return [self.node.number_at(*WORD)]


class Sockets:
    """A socket of J1939 that a test makes up; one end of a pair that can be awaited."""

    def __init__(self, rig):
        self.rig, self.options, self.sent, self.room = rig, {}, [], 100
        self.error, self.there = 0, []
        self._pair = socket.socketpair()

    def setsockopt(self, level, option, value):
        self.options[level, option] = value

    def bind(self, where):
        self.check()
        if where[0] != "can0":
            gone()
        self.bound = where

    def fileno(self):
        return self._pair[0].fileno()

    def close(self):
        for one in self._pair:
            one.close()

    def check(self):
        if self.error:
            raise OSError(self.error, os.strerror(self.error))

    def put(self, data, *ancillary, pgn=0xFEF1, source=7):
        self.there.append((data, list(ancillary), 0, ("can0", 0, pgn, source)))
        self._pair[1].send(b"x")

    def recvmsg(self, most, _ancillary):
        self.check()
        if not self.there:
            raise BlockingIOError
        assert most == 1785
        self._pair[0].recv(1)
        return self.there.pop(0)

    def sendto(self, data, where):
        self.check()
        if len(self.sent) == self.room:
            raise OSError(errno.ENOBUFS, "No buffer space available")
        self.sent.append((data, where))


class J1939(Rig):
    ports = 4
    mode = Mode.RW
    lost = "Network is down"
    safe = [Group(0xEF00, b"stop", 9), Group(0xFEF1, bytes(9))]  # noqa: RUF012
    unsafe = [Group(0xFEF1, b"go")]  # noqa: RUF012
    never_safe = [([1], "a list of Group"), ([Group(1, b"a")], "the low byte 0")]  # noqa: RUF012

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.sockets = []
        monkeypatch.setattr(socket, "socket", self.made)

    def made(self, family, kind, protocol=0, fileno=None):
        if family != socket.AF_CAN:
            return SOCKET(family, kind, protocol, fileno)
        assert (protocol, fileno) == (socket.CAN_J1939, None)
        self.sockets.append(Sockets(self))
        return self.sockets[-1]

    def entry(self, **settings):
        settings = {"source": 3, **settings}
        return entry("j1939", "can0", ports=4, **settings)

    def missing(self):
        return replace(self.entry(), address="can7")

    def prepare(self):
        self.sockets[-1].put(b"abc")

    def use(self, device):
        return device.read(1)

    def outputs(self):
        return [
            Group(pgn, data, to)
            for data, (_, _, pgn, to) in self.sockets[-1].sent[-len(self.safe) :]
        ]

    def lose(self):
        self.sockets[-1].error = errno.ENETDOWN

    def close(self):
        for one in self.sockets:
            one.close()


class Camera(Rig):
    """A camera at the edge of the kernel: a file has the memory of its buffers."""

    wrong = Mode.RW
    SIZE = 4096
    """Of a buffer: a page, so that it can be mapped."""

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.path = tmp_path / "video0"
        self.path.write_bytes(bytes(4 * self.SIZE))
        (tmp_path / "shm").mkdir()
        self.given, self.full, self.streams, self.error = [], [], False, 0
        self.offers = None
        monkeypatch.setattr(camera_driver, "SHARED", str(tmp_path / "shm"))
        monkeypatch.setattr(camera_driver, "ioctl", self.ioctl)
        monkeypatch.setattr(camera_driver.select, "select", self.select)

    def entry(self, **settings):
        settings = {"width": 32, "height": 16, "memory": "cam", **settings}
        return entry("camera", self.path, **settings)

    def shot(self, sequence, fill, stamp=(5, 6), flags=0, used=1024):
        """Fill the next buffer that was given to it; none: the frame is lost."""
        if self.given:
            number = self.given.pop(0)
            with self.path.open("r+b") as file:
                file.seek(number * self.SIZE)
                file.write(bytes((fill,)) * used)
            self.full.append((number, used, flags, *stamp, sequence))

    def select(self, *_):
        """Let a frame come, where one is waited for."""
        self.coming()

    def coming(self):
        self.shot(7, 7)

    def ioctl(self, _fd, request, data):
        d = camera_driver
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        if request == d.S_FMT:
            kind, width, height, code, *_ = d.FORMAT.unpack(data)
            size = self.offers or (width, height)
            data[:] = d.FORMAT.pack(kind, *size, code, 1, width * 2, 1024, 8, 0)
        elif request == d.REQBUFS:
            assert d.BUFFERS.unpack(data)[:3] == (4, 1, 1)
        elif request == d.QUERYBUF:
            number = d.BUFFER.unpack(data)[0]
            place = number * self.SIZE, self.SIZE
            data[:] = d.BUFFER.pack(number, 1, 0, 0, 0, 0, 0, 0, 1, *place)
        elif request == d.QBUF:
            number = d.BUFFER.unpack(data)[0]
            assert number not in self.given
            self.given.append(number)
        elif request == d.DQBUF:
            if not self.full:
                raise BlockingIOError(errno.EAGAIN, "no frame")
            number, used, flags, sec, usec, sequence = self.full.pop(0)
            rest = 1, sec, usec, sequence, 1, number * self.SIZE, self.SIZE
            data[:] = d.BUFFER.pack(number, 1, used, flags, *rest)
        else:
            assert request in {d.STREAMON, d.STREAMOFF}
            self.streams = request == d.STREAMON
            if not self.streams:
                self.given, self.full = [], []

    def prepare(self):
        self.shot(3, 3)

    def use(self, device):
        return device.status("FRAME")

    def lose(self):
        self.error = errno.ENODEV


class Slave:
    def __init__(self, name, inputs, outputs):
        self.name, self.state, self.al_status = name, 0, 0
        self.input, self._output = inputs, bytes(outputs)

    @property
    def output(self):
        return self._output

    @output.setter
    def output(self, data):
        assert isinstance(data, bytes)
        assert len(data) == len(self._output)
        self._output = data


class Ethercat(Rig):
    """A bus with two slaves at pysoem's edge; its inputs are what it was sent."""

    library, extra = "pysoem", "ethercat"
    mode = Mode.RW
    lost = "the slaves do not answer"
    expected_wkc = 6
    safe, unsafe = {1: b"\7\7\1"}, b"\1\2\3\4"
    never_safe = [({2: bytes(3)}, "0 to 3, got 2 to 4")]  # noqa: RUF012

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.slaves = [Slave("drive", b"\1\2", 3), Slave("io", b"\3", 1)]
        self.found, self.counter, self.state, self.log = 2, 6, 0, []
        self.stuck = None
        monkeypatch.setattr(pysoem, "Master", lambda: self)

    def entry(self, **settings):
        return entry("ethercat", "eth1", **{"slaves": 2, "lost": 1} | settings)

    def missing(self):
        return replace(self.entry(), address="eth9")

    def open(self, interface):
        if interface != "eth1":
            raise ConnectionError("could not open interface")
        self.log.append("open")

    def config_init(self):
        return self.found

    def config_map(self):
        self.log.append("map")

    def state_check(self, wanted, microseconds):
        assert 0 < microseconds <= 2_000_000
        return wanted if self.stuck is None else pysoem.SAFEOP_STATE

    def write_state(self):
        self.log.append(self.state)
        for one in self.slaves:
            one.state = self.state
        if self.stuck is not None:
            self.slaves[self.stuck].state = pysoem.SAFEOP_STATE
            self.slaves[self.stuck].al_status = 0x1B

    def read_state(self):
        pass

    def send_processdata(self):
        self.log.append([one.output for one in self.slaves])

    def receive_processdata(self, microseconds):
        assert microseconds == 2000
        return self.counter

    def prepare(self):
        pass

    def use(self, device):
        device.exchange()
        return device.read(3)

    def outputs(self):
        sent = [one for one in self.log if isinstance(one, list)]
        return {1: b"".join(sent[-1])[1:]}

    def lose(self):
        self.counter = -1

    def close(self):
        self.log.append("closed")


RIGS = {
    "ethercat": Ethercat,
    "camera": Camera,
    "canopen": Canopen,
    "canopen_pdo": CanopenPdo,
    "j1939": J1939,
    "spi": Spi,
    "iio_buffer": IioBuffer,
    "joystick": Joystick,
    "dynamixel": Dynamixel,
    "gpio": Gpio,
    "gpio_edges": GpioEdges,
}
