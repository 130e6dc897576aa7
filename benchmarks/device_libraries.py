"""Devices that answer at once, for what their drivers cost beside the bare library.

A server of one register speaks Modbus when it is told to. Lines of a chip and devices
on I2C and SPI answer from memory, at the edge of gpiod, smbus2 and spidev; a camera at
the edge of the kernel. Those on CAN and EtherCAT are in `device_buses`.
"""

from __future__ import annotations

import os
import socket
from mmap import mmap as mapped
from typing import TYPE_CHECKING, Any, NamedTuple, Self
from unittest import mock

import gpiod
import smbus2
from gpiod.line import Value

from pbonet.io.drivers import (
    Entry,
    Mode,
    Wait,
    camera_driver,
    database,
    i2c_driver,
    open_device,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import ExitStack
    from pathlib import Path


class Case(NamedTuple):
    """A call of a driver, the same without it, and what provides the data."""

    name: str
    prepare: Callable[[], object]
    driver: Callable[[], object]
    bare: Callable[[], object]


def cases(stack: ExitStack, folder: Path) -> list[Case]:
    """Open the devices, and return what is measured.

    Args:
        stack: Closes them.
        folder: For files.
    """
    return [
        tcp(stack),
        modbus(stack),
        iio_dac(stack, folder),
        *gpio(stack),
        i2c(stack),
        spi(stack),
        camera(stack, folder),
    ]


def opened(stack: ExitStack, entry: Entry, mode: Mode, wait: Wait = Wait.NONE) -> Any:  # noqa: ANN401 - its class is that of the driver
    """Return a device of a task that never waits; it is closed with the stack."""
    with database.using({"x": entry}):
        if Mode.WRITE in mode:
            device = open_device("x", mode=mode, wait=wait, safe=None)
        else:
            device = open_device("x", mode=mode, wait=wait)
    return stack.enter_context(device)


def listening(stack: ExitStack) -> tuple[socket.socket, str]:
    """Return a server, and its address."""
    server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    return server, f"127.0.0.1:{server.getsockname()[1]}"


def accepted(stack: ExitStack, server: socket.socket) -> socket.socket:
    """Return the server's end of a connection that was made."""
    end = stack.enter_context(server.accept()[0])
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return end


def connected(
    stack: ExitStack, server: socket.socket
) -> tuple[socket.socket, socket.socket]:
    """Return both ends of a connection without a driver; the near one never waits."""
    near = stack.enter_context(socket.create_connection(server.getsockname()))
    far = accepted(stack, server)
    near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return near, far


def tcp(stack: ExitStack) -> Case:
    """Return the case of a line over TCP."""
    server, where = listening(stack)
    line = opened(stack, Entry(driver="tcp", address=where), Mode.READ)
    ends = [accepted(stack, server)]
    near, far = connected(stack, server)
    ends.append(far)

    def send() -> None:
        for end in ends:
            end.sendall(bytes(64))

    return Case("tcp, 64 bytes", send, lambda: line.read(64), lambda: near.recv(64))


def modbus(stack: ExitStack) -> Case:
    """Return the case of one register, with the request for the next value."""
    server, where = listening(stack)
    entry = Entry(driver="modbus", address=where, settings={"timeout": 60.0})
    plc = opened(stack, entry, Mode.READ)
    end = accepted(stack, server)
    near, far = connected(stack, server)
    plc.read()  # the first request
    request = bytes.fromhex("000100000006010300000001")
    near.sendall(request)

    def answer() -> None:
        for one in (end, far):
            asked = one.recv(64)
            one.sendall(asked[:4] + b"\0\5" + asked[6:8] + b"\2\x12\x34")

    return Case(
        *("modbus (TCP), one register", answer, plc.read),
        lambda: (near.recv(64), near.send(request)),
    )


def iio_dac(stack: ExitStack, folder: Path) -> Case:
    """Return the case of one channel."""
    path = folder / "out_voltage0_raw"
    path.write_text("0\n")
    dac = opened(
        stack, Entry(driver="iio_dac", address=str(folder)), Mode.WRITE, Wait.ALL
    )
    raw = os.open(path, os.O_WRONLY)
    stack.callback(os.close, raw)
    return Case(
        *("iio_dac, one channel", int, lambda: dac.write([7])),
        lambda: os.pwrite(raw, b"7\n", 0),
    )


class Lines:
    """A chip of eight lines, and the request of some of them."""

    num_lines = 8

    def __init__(self) -> None:
        self.fd, self._write = os.pipe()
        self._edges: list[gpiod.EdgeEvent] = []
        self._number = 0

    def __call__(self, _path: str) -> Lines:
        """Return itself, as the chip of whichever path."""
        return self

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the chip."""

    def get_info(self) -> Lines:
        """Return itself, which has the number of lines."""
        return self

    def request_lines(self, **_: object) -> Lines:
        """Return itself, as the request."""
        return self

    def get_values(self, lines: Sequence[int]) -> list[Value]:
        """Return a value for each line."""
        return [Value.ACTIVE for _ in lines]

    def edge(self) -> None:
        """Let an edge come."""
        self._number += 1
        kind = gpiod.EdgeEvent.Type.RISING_EDGE.value
        self._edges = [gpiod.EdgeEvent(kind, 7, 0, self._number, self._number)]

    def wait_edge_events(self, _seconds: float) -> bool:
        """Return whether there is an edge."""
        return bool(self._edges)

    def read_edge_events(self, _limit: int) -> list[gpiod.EdgeEvent]:
        """Return the edge that has come."""
        found, self._edges = self._edges, []
        return found

    def release(self) -> None:
        """Give the lines back."""


def gpio(stack: ExitStack) -> list[Case]:
    """Return the cases of one line, and of its edges."""
    chips = [Lines() for _ in range(2)]
    devices: list[Any] = []
    for chip, driver, wait in zip(
        chips, ("gpio", "gpio_edges"), (Wait.ALL, Wait.NONE), strict=True
    ):
        with mock.patch.object(gpiod, "Chip", chip):
            entry = Entry(driver=driver, address="chip")
            devices.append(opened(stack, entry, Mode.READ, wait))
    line, edges = devices
    plain = Lines()

    def both() -> None:
        chips[1].edge()
        plain.edge()

    return [
        Case("gpio, one line", int, line.read, lambda: plain.get_values([0])),
        Case(
            *("gpio_edges, one edge", both, lambda: edges.read(1)),
            lambda: plain.wait_edge_events(0) and plain.read_edge_events(1),
        ),
    ]


class Memory:
    """A device on I2C or SPI that answers from memory."""

    fd = -1

    def open(self, path: str) -> None:
        """Open a bus of I2C."""

    def open_path(self, path: str) -> None:
        """Open a bus of SPI."""

    def close(self) -> None:
        """Close the bus."""

    def read_byte_data(self, address: int, register: int) -> int:
        """Return a register of a device on I2C."""
        return (address + register) & 0xFF

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write a register of a device on I2C."""

    def xfer2(self, values: Sequence[int]) -> list[int]:
        """Return what a device on SPI answers."""
        return list(values)


def i2c(stack: ExitStack) -> Case:
    """Return the case of one register."""
    bus = Memory()
    entry = Entry(driver="i2c", address="/dev/i2c-1:0x48", settings={"registers": [1]})
    with (
        mock.patch.object(smbus2, "SMBus", return_value=bus),
        mock.patch.object(i2c_driver, "ioctl", return_value=0),
    ):
        chip = opened(stack, entry, Mode.READ, Wait.ALL)
    return Case(
        *("i2c, one register", int, chip.read), lambda: bus.read_byte_data(0x48, 1)
    )


def spi(stack: ExitStack) -> Case:
    """Return the case of eight bytes."""
    bus = Memory()
    with mock.patch("spidev.SpiDev", return_value=bus):
        entry = Entry(driver="spi", address="/dev/spidev0.0")
        chip = opened(stack, entry, Mode.RW, Wait.ALL)
    data = bytes(8)
    return Case(
        *("spi, 8 bytes", int, lambda: chip.transfer(data)),
        lambda: bytes(bus.xfer2(list(data))),
    )


WIDTH, HEIGHT = 640, 480
PICTURE = 2 * WIDTH * HEIGHT
"""Bytes of a picture in YUYV: a number of pages."""
_BUFFERS = 4


class Pictures:
    """A camera at the edge of the kernel: a file has the memory of its buffers.

    Its pictures are there already: the benchmark measures what is done with them.
    """

    def __init__(self, path: Path) -> None:
        self._given: list[int] = []
        self._full: list[int] = []
        self._sequence = 0
        path.write_bytes(os.urandom(PICTURE) * _BUFFERS)

    def picture(self) -> None:
        """Let a picture come, in the next buffer that it was given."""
        self._full.append(self._given.pop(0))

    def ioctl(self, _fd: int, request: int, data: bytearray) -> None:
        """Do what the kernel does with a request."""
        d = camera_driver
        if request == d.DQBUF:
            if not self._full:
                raise BlockingIOError
            number, self._sequence = self._full.pop(0), self._sequence + 1
            of_picture = PICTURE, 0, 1, 5, 6, self._sequence, d.MAPPED
            d.BUFFER.pack_into(
                *(data, 0, number, d.CAPTURE, *of_picture),
                *(number * PICTURE, PICTURE),
            )
        elif request == d.QBUF:
            self._given.append(d.BUFFER.unpack(data)[0])
        elif request == d.QUERYBUF:
            number = d.BUFFER.unpack(data)[0]
            rest = d.CAPTURE, 0, 0, 0, 0, 0, 0, d.MAPPED, number * PICTURE, PICTURE
            d.BUFFER.pack_into(data, 0, number, *rest)
        elif request == d.S_FMT:
            kind, width, height, code, *_ = d.FORMAT.unpack(data)
            line = 2 * width, PICTURE, 0, 0
            d.FORMAT.pack_into(data, 0, kind, width, height, code, 0, *line)


def camera(stack: ExitStack, folder: Path) -> Case:
    """Return the case of one picture, which is copied into shared memory."""
    there, plain = (Pictures(folder / name) for name in ("video0", "video1"))
    (folder / "shm").mkdir()
    for name, value in (("ioctl", there.ioctl), ("SHARED", str(folder / "shm"))):
        stack.enter_context(mock.patch.object(camera_driver, name, value))
    entry = Entry(driver="camera", address=str(folder / "video0"))
    device = opened(stack, entry, Mode.READ)
    buffers, shown = (
        stack.enter_context(shared(path, PICTURE * _BUFFERS))
        for path in (folder / "video1", folder / "shown")
    )
    room = bytearray(camera_driver.BUFFER.size)
    for number in range(_BUFFERS):
        room[:4] = number.to_bytes(4, "little")
        plain.ioctl(-1, camera_driver.QBUF, room)

    def both() -> None:
        there.picture()
        plain.picture()

    def take() -> None:
        plain.ioctl(-1, camera_driver.DQBUF, room)
        begin = camera_driver.BUFFER.unpack(room)[0] * PICTURE
        with memoryview(buffers) as view:
            shown[begin : begin + PICTURE] = view[begin : begin + PICTURE]
        plain.ioctl(-1, camera_driver.QBUF, room)

    return Case(
        f"camera, {WIDTH} x {HEIGHT} YUYV", both, lambda: device.status("FRAME"), take
    )


def shared(path: Path, size: int) -> mapped:
    """Return the memory of a file, which is made that large."""
    with path.open("a+b") as file:
        file.truncate(size)
        return mapped(file.fileno(), size)
