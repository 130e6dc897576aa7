"""Groups of J1939 by a socket that a test makes up; see test_io_drivers_uml for the
kernel's own."""

from __future__ import annotations

import errno
import random
import socket
import struct

import pytest
from device_rigs import J1939

from pbonet.errors import DeviceError
from pbonet.io.drivers import Group, Mode, Wait, database, device, open_device


@pytest.fixture
def rig(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    one = J1939(monkeypatch, tmp_path)
    yield one
    one.close()


def opened(rig, mode=Mode.RW, wait=Wait.NONE, safe=None, **settings):
    with database.using({"x": rig.entry(**settings)}):
        return open_device("x", mode=mode, wait=wait, safe=safe)


def test_groups_have_source_destination_and_stamp(rig):
    with opened(rig, listen=True, priority=3) as bus:
        (one,) = rig.sockets
        assert one.bound == ("can0", 0, socket.J1939_NO_PGN, 3)
        assert one.options[107, socket.SO_J1939_PROMISC] == 1
        assert one.options[107, socket.SO_J1939_SEND_PRIO] == 3
        assert bus.read(9) == []
        stamp = (socket.SOL_SOCKET, 35, struct.pack("@qq", 5, 6))
        one.put(bytes(1785), stamp)
        one.put(b"x", (107, 1, b"\3"), pgn=0xEF00, source=9)
        one.put(b"own", source=3)
        assert bus.read(9) == [
            Group(0xFEF1, bytes(1785), 0xFF, 7, 5_000_000_006),
            Group(0xEF00, b"x", 3, 9),
        ]
        assert bus.write([Group(0xFEF1, b"ab"), Group(0xEF00, b"c", 9)]) == 2
        assert one.sent == [
            (b"ab", ("can0", 0, 0xFEF1, 0xFF)), (b"c", ("can0", 0, 0xEF00, 9))
        ]  # fmt: skip
        one.room = 3
        assert bus.write([Group(0xFEF1, b"ab")] * 2) == 1


def test_garbage_comes_as_it_was_sent(rig):
    """A hundred thousand bytes, and more beside them than the kernel says today."""
    chance, left = random.Random(1), 100_000
    with opened(rig) as bus:
        while left > 0:
            data = chance.randbytes(chance.randrange(1786))
            pgn, source = chance.randrange(1 << 18), chance.randrange(4, 256)
            level, kind = chance.choice(((107, 9), (socket.SOL_SOCKET, 4)))
            beside = level, kind, chance.randbytes(4)
            rig.sockets[0].put(data, beside, pgn=pgn, source=source)
            assert bus.read(9) == [Group(pgn, data, 0xFF, source)]
            left -= len(data)


@pytest.mark.parametrize(
    ("group", "told"),
    [
        (Group(0x40000, b"a"), "0 to 3FFFFh"),
        (Group(-1, b"a"), "0 to 3FFFFh"),
        (Group(0xEF01, b"a"), "low byte 0"),
        (Group(0xFEF1, b""), "1 to 1785 bytes"),
        (Group(0xFEF1, bytes(1786)), "1 to 1785 bytes"),
        (Group(0xEF00, b"a", 256), "destination of 0 to 255"),
        (Group(0xFEF1, b"a", 3), "expected no destination"),
    ],
)
def test_groups_that_a_bus_cannot_have_are_refused(rig, group, told):
    with opened(rig) as bus:
        with pytest.raises(DeviceError, match="no such groups") as caught:
            bus.write([Group(0xFEF1, b"a"), group])
        assert told in str(caught.value)
        assert rig.sockets[0].sent == []


def test_a_destination_that_does_not_answer_is_told_and_the_bus_works_on(rig):
    with opened(rig) as bus:
        rig.sockets[0].error = errno.ETIME
        with pytest.raises(DeviceError, match="did not reach its destination"):
            bus.write([Group(0xEF00, bytes(100), 9)])
        rig.sockets[0].error = 0
        assert bus.write([Group(0xEF00, bytes(100), 9)]) == 1


@pytest.mark.parametrize(
    ("wait", "got"), [(Wait.ALL, 2), (Wait.ONE, 1), (Wait.NOALL, 0)]
)
def test_groups_are_awaited_as_the_device_was_opened(rig, wait, got):
    with opened(rig, wait=wait) as bus:
        for _ in range(got or 1):
            rig.sockets[0].put(b"a")
        assert len(bus.read(2)) == got


def test_a_bus_that_takes_no_safe_groups_is_told(rig):
    """And one that has room for some at a time gets all of them, however it waits."""
    safe = [Group(0xFEF1, b"a"), Group(0xFEF1, b"b")]
    rig.patch.setattr(device, "PATIENCE", 0.05)
    bus = opened(rig, safe=safe)
    rig.sockets[0].room = 1
    with pytest.raises(DeviceError, match="timed out"):
        bus.close()
    bus = opened(rig, safe=safe)
    give = bus._give
    rig.patch.setattr(bus, "_give", lambda some: give(some[:1]))
    bus.close()
    assert [one for one, _ in rig.sockets[1].sent] == [b"a", b"b"]


def test_a_kernel_without_it_is_named(rig):
    def no(*_):
        raise OSError(errno.EPROTONOSUPPORT, "Protocol not supported")

    rig.made = no
    rig.patch.setattr(socket, "socket", no)
    with pytest.raises(DeviceError, match="modprobe can-j1939"):
        opened(rig)
    for wrong in ({"source": 254}, {"priority": 8}, {}):
        entry = rig.entry(**wrong)
        if not wrong:
            entry.settings.pop("source")
        with database.using({"x": entry}), pytest.raises(DeviceError, match="setting"):
            open_device("x")
