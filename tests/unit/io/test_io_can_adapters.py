"""CAN adapters on a serial line (slcan of python-can), at the end of a terminal."""

from __future__ import annotations

import os
import random
import time
from contextlib import suppress

import can
import pytest
from can.interfaces import slcan
from scripted_motors import Adapter
from watching import wait_for

from pbonet.errors import DeviceError
from pbonet.io.drivers import Entry, Frame, Mode, Wait, database, open_device

WHOLE = b"t1232abcd\r"


@pytest.fixture
def adapter(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    one = Adapter()
    made = {"interface": "slcan"}
    entries = {
        "can": Entry(driver="can", address=one.path, settings=made),
        "twice": Entry(driver="can", address=f"{one.path}@9600", settings=made),
        "slow": Entry(driver="can", address=one.path, settings={**made, "settle": 2.5}),
        "other": Entry(driver="can", address="can0", settings={"settle": 1.0}),
    }
    with database.using(entries, "arm0/reads"):
        yield one
    one.shutdown()


def opened(name="can", port=0, mode=Mode.RW):
    safe = {"safe": None} if Mode.WRITE in mode else {}
    return open_device(name, port, mode=mode, wait=Wait.NONE, **safe)


def test_frames_go_both_ways(adapter):
    with opened() as bus:
        assert bus.write([Frame(0x123, b"\1\2")]) == 1
        one = wait_for(lambda: adapter.recv(0), "the frame")
        assert (one.arbitration_id, bytes(one.data)) == (0x123, b"\1\2")
        adapter.send(one)
        (back,) = wait_for(lambda: bus.read(9), "the same")
        assert (back.id, back.data, back.extended) == (0x123, b"\1\2", False)


@pytest.mark.usefixtures("adapter")
@pytest.mark.parametrize(("name", "told"), [("can", 0.0), ("slow", 2.5)])
def test_it_is_ready_at_once_unless_it_needs_time(monkeypatch, name, told):
    slept = []
    monkeypatch.setattr(slcan.time, "sleep", slept.append)
    opened(name).close()
    assert slept == [told]


@pytest.mark.usefixtures("adapter")
def test_a_time_that_nothing_would_take_is_refused():
    with pytest.raises(DeviceError, match="only the interface slcan takes settle"):
        opened("other")


def test_what_it_acknowledges_hides_no_frame(adapter):
    with opened() as bus:
        os.write(adapter.fd, b"z\r" * 50 + b"\r\a" + WHOLE * 3)
        found = []
        wait_for(lambda: found.extend(bus.read(9)) or found, "a frame")
        assert [one.data for one in found] == [b"\xab\xcd"] * 3


def test_it_has_one_user_who_is_not_disturbed_by_another(adapter):
    with opened() as bus:
        adapter.recv(0)
        for name, port in (("can", 1), ("twice", 2)):
            with pytest.raises(DeviceError, match="an adapter that is open already"):
                opened(name, port)
        assert not adapter.recv(0)
        assert adapter._is_open
        os.write(adapter.fd, WHOLE)
        assert wait_for(lambda: bus.read(9), "a frame")
    opened("twice", 2).close()


@pytest.mark.parametrize(
    "line",
    [
        b"t12\r",
        b"t1232abc\r",
        b"t1238abcd\r",
        b"tz232abcd\r",
        b"t9992abcd\r",
        b"d1235\r",
        b"T\r",
        b"TFFFFFFFF0\r",
        b"b1\r",
        b"\xff\xfe\r",
    ],
)
def test_a_damaged_line_is_told_and_the_next_one_is_read(adapter, line):
    with opened() as bus:
        os.write(adapter.fd, line)
        with pytest.raises(DeviceError, match="what the CAN adapter sends is no frame"):
            wait_for(lambda: bus.read(9), "an error")
        os.write(adapter.fd, WHOLE)
        (one,) = wait_for(lambda: bus.read(9), "the next frame")
        assert one.data == b"\xab\xcd"


def test_garbage_without_the_end_of_a_line_is_told_and_not_kept(adapter):
    with opened() as bus:
        for _ in range(3):
            for _ in range(20):
                os.write(adapter.fd, b"t" * 100)
            with pytest.raises(DeviceError, match="CAN adapter sends is no frame"):
                wait_for(lambda: bus.read(9), "an error")
        kept = bus._bus._bus._buffer
        assert len(kept) < 2000, "what one look finds on the line"
        with suppress(DeviceError):
            while kept or bus.read(9):
                os.write(adapter.fd, b"\r")
                bus.read(9)
        os.write(adapter.fd, WHOLE)
        (one,) = wait_for(lambda: bus.read(9), "the next frame")
        assert one.data == b"\xab\xcd"


def test_garbage_ends_in_frames_or_errors(adapter):
    """A hundred thousand bytes, many of them like parts of frames."""
    chance, many = random.Random(1), b""
    while len(many) < 100_000:
        many += chance.choice((chance.randbytes(9), b"t1232ab", b"cd\r", b"T", b"\r"))
    with opened() as bus:
        while many:
            with suppress(BlockingIOError):
                many = many[os.write(adapter.fd, many) :]
            with suppress(DeviceError):
                for one in bus.read(9):
                    assert len(one.data) <= 8
            assert bus.is_open
        found = []

        def come():
            os.write(adapter.fd, b"\r" + WHOLE)
            with suppress(DeviceError):
                found.extend(bus.read(99))
            return found and found[-1].data == b"\xab\xcd"

        wait_for(come, "frames")


def test_one_that_takes_no_more_holds_no_one_up(adapter):
    with opened() as bus:
        while bus.write([Frame(1, bytes(8))]):
            pass
        assert bus.write([Frame(1)]) == 0
        with suppress(BlockingIOError):
            while os.read(adapter.fd, 65536):
                pass  # closing it needs room on the line


def test_who_only_writes_leaves_nothing_behind_that_stops_the_adapter(adapter):
    """The line has room for some thousand bytes only."""
    with opened(mode=Mode.WRITE) as bus:
        left = WHOLE * 10_000
        for _ in range(300):
            with suppress(BlockingIOError):
                left = left[os.write(adapter.fd, left[:4000]) :]
            while adapter.recv(0):
                pass
            assert bus.write([Frame(1)]) == 1
        assert not left


def test_an_unplugged_one_is_lost(adapter):
    bus = opened()
    os.close(adapter.fd)
    with pytest.raises(DeviceError, match="the device is gone"):
        wait_for(lambda: bus.read(9), "an error")
    assert not bus.is_open
    adapter.fd = os.dup(adapter._slave)


class Busy:
    """A bus on which others talk, of which no one answers."""

    left = 400

    def receive(self, timeout):
        time.sleep(min(timeout, 0.01))
        if timeout < 0.01:
            return None, False
        self.left -= 1
        assert self.left, "it waits for as long as others talk"
        return can.Message(arbitration_id=0x700, is_extended_id=False), False


def test_a_node_that_is_silent_is_told_while_others_talk(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    made = {"interface": "virtual", "objects": ["6064:00/32"], "timeout": 0.05}
    entry = Entry(driver="canopen", address="bus of a test", settings=made)
    busy, at = Busy(), "can.interfaces.virtual.VirtualBus._recv_internal"
    monkeypatch.setattr(at, lambda _, timeout: busy.receive(timeout))
    with (
        database.using({"x": entry}, "arm0/reads"),
        pytest.raises(DeviceError, match="the device does not answer"),
    ):
        open_device("x", mode=Mode.READ)
