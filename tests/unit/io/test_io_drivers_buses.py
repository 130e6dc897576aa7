"""Drivers of CAN and I2C: over python-can's virtual bus, and with smbus2 replaced."""

from __future__ import annotations

import errno
import os
import random
import sys
import threading
import time

import can
import pytest
import smbus2

from pbonet.errors import DeviceError
from pbonet.io.drivers import (
    Entry,
    Frame,
    Mode,
    Wait,
    database,
    i2c_driver,
    open_device,
)
from pbonet.outside import Player, Tape, using as recording

CHIP = {"registers": [1, 2, 9], "bits": 16}


def bus(**settings):
    settings = {"interface": "virtual", **settings}
    return Entry(driver="can", address="bus of a test", settings=settings)


def chip(address="/dev/i2c-1:0x48", **settings):
    return Entry(driver="i2c", address=address, settings=settings)


@pytest.fixture(autouse=True)
def devices(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    entries = {
        "can": bus(),
        "fd": bus(fd=True),
        "some": bus(filters=["181/7FF", "18FF0000/1FFF0000"]),
        "chip": chip(**CHIP),
        "big": chip(**CHIP, order="big"),
        "bytes": chip(registers=[1, 2, 9]),
        "last": Entry(driver="i2c", address="/dev/i2c-1:0x48", first=2, settings=CHIP),
    }
    with database.using(entries, "arm0/reads"):
        yield


@pytest.fixture
def raw():
    """The same bus, as python-can has it."""
    with can.Bus("bus of a test", interface="virtual") as other:
        yield other


def opened(name="can", port=0, wait=Wait.NONE):
    return open_device(name, port, mode=Mode.RW, safe=None, wait=wait)


def plain(frames):
    return [one._replace(stamp_ns=0) for one in frames]


def test_two_openings_of_a_bus_talk():
    sent = [
        Frame(0x7FF, b"\1\2\3"),
        Frame(0x1FFFFFFF, extended=True),
        Frame(1, bytes(64), fd=True),
        Frame(2, remote=True),
    ]
    before = time.time_ns() - 1000
    with opened("fd", 0) as a, opened("fd", 1) as b:
        assert a.write(sent) == 4
        found = b.read(9)
        assert plain(found) == sent
        assert all(before <= one.stamp_ns <= time.time_ns() + 1000 for one in found)
        assert b.read(9) == a.read(9) == []
        with pytest.raises(DeviceError, match="a port of the device is taken"):
            opened("fd", 1)


def test_a_frame_of_can_fd_has_the_bit_rate_of_its_data(raw):
    with opened("fd") as a:
        a.write([Frame(1, fd=True), Frame(1)])
        assert [raw.recv(0).bitrate_switch for _ in range(2)] == [True, False]


@pytest.mark.parametrize(
    ("wait", "there", "asked", "got"),
    [
        (Wait.NONE, 0, 2, 0),
        (Wait.NONE, 3, 2, 2),
        (Wait.NOALL, 1, 2, 0),
        (Wait.NOALL, 2, 2, 2),
        (Wait.ONE, 1, 2, 1),
        (Wait.ALL, 3, 2, 2),
    ],
)
def test_frames_are_awaited_as_the_device_was_opened(raw, wait, there, asked, got):
    with opened(wait=wait) as a:
        for k in range(there):
            raw.send(can.Message(arbitration_id=k))
        assert [one.id for one in a.read(asked)] == list(range(got))
        for k in range(there, 4):
            raw.send(can.Message(arbitration_id=k))
        assert [one.id for one in a.read(4 - got)] == list(range(got, 4))


@pytest.mark.parametrize(("wait", "count"), [(Wait.ONE, 1), (Wait.ALL, 3)])
def test_a_reader_waits_for_frames(raw, wait, count):
    found = []
    with opened(wait=wait) as a:
        reads = threading.Thread(target=lambda: found.extend(a.read(count)))
        reads.start()
        for k in range(count):
            raw.send(can.Message(arbitration_id=k))
        reads.join()
    assert [one.id for one in found] == list(range(count))


def test_filters_hold_and_what_they_refuse_takes_no_read(raw):
    with opened("some") as some:
        for identity, extended in ((0x182, False), (0x181, True), (0x18FE0000, True)):
            for _ in range(50):
                raw.send(can.Message(arbitration_id=identity, is_extended_id=extended))
        raw.send(can.Message(arbitration_id=0x181, is_extended_id=False))
        raw.send(can.Message(arbitration_id=0x18FF0012, is_extended_id=True))
        assert [one.id for one in some.read(9)] == [0x181, 0x18FF0012]


def test_a_full_bus_takes_no_more_and_is_awaited():
    with opened(port=0) as none, opened(port=1) as reader:
        assert none.write([Frame(1)] * 1100) == 1024
        assert none.write([Frame(1)]) == 0
        with opened(port=2, wait=Wait.ALL) as waits:
            done = []
            writes = threading.Thread(
                target=lambda: done.append(waits.write([Frame(7)] * 2))
            )
            writes.start()
            found = []
            while len(found) < 1026:
                found += reader.read(9)
            writes.join()
        assert done == [2]
        assert sum(one.id == 7 for one in found) >= 2


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (Frame(0x800), "an identity of 0 to 7FFh"),
        (Frame(-1), "an identity of 0 to 7FFh"),
        (Frame(0x20000000, extended=True), "an identity of 0 to 1FFFFFFFh"),
        (Frame(1, bytes(9)), "up to 8 bytes"),
        (Frame(1, b"a", remote=True), "a remote frame without data"),
        (Frame(1, fd=True), "a device with `fd = true`"),
    ],
)
def test_frames_that_a_bus_cannot_have_are_refused(raw, frame, told):
    with opened() as a:
        with pytest.raises(DeviceError, match="the bus has no such frames") as caught:
            a.write([Frame(1), frame])
        assert told in str(caught.value)
        assert raw.recv(0) is None, "none of them was sent"
        assert a.write([Frame(1)]) == 1, "the device works"
    with opened("fd") as fd, pytest.raises(DeviceError, match="no such frames"):
        fd.write([Frame(1, bytes(13), fd=True)])


def test_a_controller_that_leaves_the_bus_is_lost(raw):
    with opened() as a:
        raw.send(can.Message(arbitration_id=0x4, is_error_frame=True))
        raw.send(can.Message(arbitration_id=5))
        assert [one.id for one in a.read(9)] == [5]
        raw.send(can.Message(arbitration_id=0x40, is_error_frame=True))
        with pytest.raises(DeviceError, match=r"the device is gone.*bus-off"):
            a.read(9)
        with pytest.raises(DeviceError, match="the device is not open"):
            a.read(9)
    opened().close()  # its port is free


def test_who_only_writes_holds_no_one_up_and_learns_that_the_bus_is_gone(raw):
    """An end of the virtual bus that is full refuses its senders."""
    with open_device("can", mode=Mode.WRITE, safe=None, wait=Wait.NONE) as a:
        for k in range(3000):
            if k % 1000 == 0:
                assert a.write([Frame(1)]) == 1
            raw.send(can.Message(arbitration_id=5), timeout=0)
        raw.send(can.Message(arbitration_id=0x40, is_error_frame=True), timeout=0)
        with pytest.raises(DeviceError, match=r"the device is gone.*bus-off"):
            a.write([Frame(1)])


def test_garbage_comes_as_it_was_sent(raw):
    """A hundred thousand bytes."""
    chance = random.Random(1)
    with opened() as a:
        for _ in range(125):
            sent = [
                Frame(chance.randrange(1 << 29), chance.randbytes(8), extended=True)
                for _ in range(100)
            ]
            for one in sent:
                raw.send(can.Message(arbitration_id=one.id, data=one.data))
            assert plain(a.read(101)) == sent


def test_directions_of_a_bus_are_kept():
    told = "not open in this direction"
    with (
        open_device("can", mode=Mode.READ) as a,
        pytest.raises(DeviceError, match=told),
    ):
        a.write([Frame(1)])
    with (
        open_device("can", mode=Mode.WRITE, safe=None) as a,
        pytest.raises(DeviceError, match=told),
    ):
        a.read(1)


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        (bus(boud=1), "boud"),
        (bus(filters=["181"]), "filters"),
        (bus(filters=["8FF/7FF"]), "filters"),
        (bus(interface="socketcan", bitrate=500_000), "ip link set can0 type can"),
        (bus(interface="abacus"), "the CAN bus cannot be opened"),
        (chip(), "registers"),
        (chip(registers=[]), "registers"),
        (chip(registers=[256]), "registers"),
        (chip(registers=[1], bits=12), "bits"),
        (chip("/dev/i2c-1", registers=[1]), "BUS:DEVICE"),
        (chip("/dev/i2c-1:0x80", registers=[1]), "BUS:DEVICE"),
        (chip("/dev/null:0x48", registers=[1]), "the I2C bus cannot be opened"),
        (chip("/dev/i2c-none:0x48", registers=[1]), "No such file"),
    ],
)
def test_wrong_settings_are_refused_at_open(entry, told):
    with database.using({"x": entry}), pytest.raises(DeviceError) as caught:
        open_device("x", mode=Mode.READ)
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("name", "package", "extra"), [("can", "can", "can"), ("chip", "smbus2", "i2c")]
)
def test_a_missing_package_is_named(monkeypatch, name, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DeviceError, match=rf"pip install 'pbonet\[{extra}\]'"):
        open_device(name, mode=Mode.READ)


class Chip:
    """A chip behind the interface of smbus2; words have the first byte lowest."""

    def __init__(self):
        self.fd, self.bytes, self.paths, self.error = -1, {}, [], 0

    def open(self, path):
        self.paths.append(path)

    def close(self):
        self.paths.clear()

    def read_byte_data(self, address, register):
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        return self.bytes.get((address, register), 0)

    def write_byte_data(self, address, register, value):
        assert 0 <= value <= 0xFF
        self.bytes[address, register] = value

    def read_word_data(self, address, register):
        low = self.read_byte_data(address, register)
        return low | self.bytes.get((address, register, 1), 0) << 8

    def write_word_data(self, address, register, value):
        self.write_byte_data(address, register, value & 0xFF)
        self.bytes[address, register, 1] = value >> 8


@pytest.fixture
def there(monkeypatch):
    found = Chip()
    monkeypatch.setattr(smbus2, "SMBus", lambda: found)
    monkeypatch.setattr(i2c_driver, "ioctl", lambda *_: 0)
    return found


@pytest.mark.parametrize(("name", "first"), [("chip", 0x34), ("big", 0x12)])
def test_registers_have_their_order_of_bytes(there, name, first):
    with open_device(name, 1, 2, mode=Mode.RW, safe=None, size=16, signed=True) as two:
        two.write([0x1234, -2])
        assert there.paths == ["/dev/i2c-1"]
        assert there.bytes[0x48, 2] == first
        assert {key[1] for key in there.bytes} == {2, 9}
        assert two.read() == [0x1234, -2]
        assert (two.status("PORTNUM"), two.status("PORTSIZE", 1)) == (3, 16)
    assert there.paths == []


def test_registers_of_bytes(there):
    with open_device("bytes", 0, 2, mode=Mode.RW, safe=None, size=8) as three:
        three.write([1, 2, 0xFF])
        assert there.bytes == {(0x48, 1): 1, (0x48, 2): 2, (0x48, 9): 0xFF}
        assert three.read() == [1, 2, 0xFF]


def test_logical_devices_share_a_chip(there):
    with open_device("last", mode=Mode.RW, safe=None) as last:
        last.write([7])
        assert there.bytes[0x48, 9] == 7
        assert last.status("PORTNUM") == 1
        with pytest.raises(DeviceError, match="a port of the device is taken"):
            open_device("chip", 2)
        open_device("chip", 0, 1).close()


@pytest.mark.parametrize(
    ("name", "start", "end", "told"),
    [
        ("chip", 1, 3, "expected 0 to 2, got 1 to 3"),
        ("last", 1, 1, "expected 0 to 0, got 1 to 1"),
    ],
)
def test_ports_without_a_register_are_refused(there, name, start, end, told):
    with pytest.raises(DeviceError, match=told):
        open_device(name, start, end, mode=Mode.READ)
    assert there.paths == []


def test_a_chip_that_does_not_answer_is_lost(there):
    with open_device("chip", mode=Mode.READ) as one:
        assert one.read() == [0]
        there.error = errno.ENXIO
        with pytest.raises(DeviceError, match="the device is gone"):
            one.read()
        assert there.paths == []
        with pytest.raises(DeviceError, match="the device is not open"):
            one.read()


def test_a_driver_of_the_kernel_at_the_chip_is_named(there, monkeypatch):
    def busy(*_):
        raise OSError(errno.EBUSY, "Device or resource busy")

    monkeypatch.setattr(i2c_driver, "ioctl", busy)
    with pytest.raises(DeviceError, match="got Device or resource busy"):
        open_device("chip", mode=Mode.READ)
    assert there.paths == []


def test_both_replay_without_a_device(there, raw, monkeypatch):
    def run():
        found = []
        with opened() as a, open_device("chip", mode=Mode.RW, safe=None) as one:
            if not a.outside.plays:
                raw.send(can.Message(arbitration_id=7, data=b"abc"))
            found += [a.read(9), a.read(9), a.write([Frame(1)])]
            one.write([5])
            found.append(one.read())
            if not a.outside.plays:
                raw.send(can.Message(arbitration_id=0x40, is_error_frame=True))
            with pytest.raises(DeviceError) as caught:
                a.read(1)
        return [*found, str(caught.value)]

    tape = Tape()
    with recording(tape):
        first = run()
    assert plain(first[0]) == [Frame(7, b"abc", extended=True)]
    assert first[1:4] == [[], 1, [5]]
    monkeypatch.setitem(sys.modules, "can", None)
    monkeypatch.setitem(sys.modules, "smbus2", None)
    player = Player()
    player.feed(tape.take())
    with database.using({}), recording(player):
        assert run() == first
    assert there.paths == []
