"""Modbus: against the server of pymodbus, over TCP and a serial line, and against ends
that are silent, strange or gone."""

from __future__ import annotations

import os
import re
import select
import socket
import struct
import threading
import tty
from contextlib import contextmanager

import pytest
from modbus_rig import COUNT, serving
from pymodbus.framer import FramerType
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from watching import wait_for

from pbonet.errors import DeviceError
from pbonet.io import no_devices
from pbonet.io.drivers import Entry, Mode, Wait, database, open_device, port_claims
from pbonet.io.drivers.modbus_driver import ModbusSettings
from pbonet.io.drivers.modbus_protocol import crc
from pbonet.outside import Player, Tape, using as recording

RTU = {"baud": 115200, "parity": "N", "timeout": 30.0}
"""A pseudo-terminal has no parity."""


@pytest.fixture(autouse=True)
def run_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))


@pytest.fixture(scope="module")
def tcp():
    """The address of a server of pymodbus."""
    with serving(lambda units: ModbusTcpServer(units, address=("127.0.0.1", 0))) as one:
        yield f"127.0.0.1:{one.transport.sockets[0].getsockname()[1]}"


@contextmanager
def joined():
    """Give the names of two terminals, each the other end of the other."""
    pairs = [os.openpty(), os.openpty()]
    for master, slave in pairs:
        tty.setraw(master)
        tty.setraw(slave)
    (a, _), (b, _) = pairs
    ends, stop = os.pipe()

    def move():
        while ends not in (ready := select.select([a, b, ends], [], [])[0]):
            for one in ready:
                os.write(b if one == a else a, os.read(one, 4096))

    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield [os.ttyname(slave) for _, slave in pairs]
    finally:
        os.write(stop, b"x")
        thread.join()
        for fd in (*pairs[0], *pairs[1], ends, stop):
            os.close(fd)


@pytest.fixture(scope="module")
def rtu():
    """The device file of a serial line with two units of pymodbus."""
    with (
        joined() as (ours, theirs),
        serving(
            lambda units: ModbusSerialServer(
                units, framer=FramerType.RTU, port=theirs, baudrate=115200
            ),
            units=(1, 2),
            count=800,
        ),
    ):
        yield ours


@pytest.fixture(params=["tcp", "rtu"])
def line(request):
    """An address, and the settings that go with it."""
    address = request.getfixturevalue(request.param)
    return address, RTU if request.param == "rtu" else {"timeout": 30.0}


def device(address, first=0, **settings):
    return Entry(driver="modbus", address=address, first=first, settings=settings)


@contextmanager
def opened(entry, *ports, mode=Mode.RW, **how):
    with (
        database.using({"plc": entry}),
        open_device("plc", *ports, mode=mode, safe=None, **how) as x,
    ):
        yield x


@pytest.mark.parametrize(
    ("table", "value"),
    [
        ("holding", lambda k: k * 7),
        ("input", lambda k: k * 7 + 1),
        ("coils", lambda k: k % 3 == 0),
        ("discrete", lambda k: k % 3 == 0),
    ],
)
def test_each_table_is_read(line, table, value):
    address, settings = line
    entry = device(address, 5, table=table, **settings)
    with opened(entry, 3, 260, mode=Mode.READ) as plc:
        assert plc.read() == [value(k) for k in range(8, 266)]
        assert plc.status("PORTSIZE", 3) == (16 if table in {"holding", "input"} else 1)


def test_more_than_one_request_holds_is_read_and_written(tcp):
    with opened(device(tcp, 50, table="coils"), 0, 2199) as plc:
        values = [k % 7 == 0 for k in range(2200)]
        plc.write(values)
        assert plc.read() == values
    with opened(device(tcp, 1000), 0, 299) as plc:
        plc.write([-k for k in range(300)])
        assert plc.read() == [-k & 0xFFFF for k in range(300)]


def test_what_is_written_is_in_the_device(line):
    address, settings = line
    with opened(device(address, 300, **settings), 1, 3, signed=True) as plc:
        plc.write([-1, 0x1234, 70000])
        assert plc.read() == [-1, 0x1234, 70000 & 0xFFFF]
    with opened(device(address, 300, **settings), mode=Mode.READ) as plc:
        assert plc.read() == [2100], "the register before is as it was"


def test_a_periodic_task_never_waits(line):
    address, settings = line
    entry = device(address, 600, **settings)
    with opened(entry, 0, 199, wait=Wait.NONE) as plc:
        assert plc.read() == []
        before = [k * 7 for k in range(600, 800)]
        assert wait_for(plc.read, "the values") == before
        for k in range(50):
            plc.write([k] * 200)
        now = [k] * 200
        wait_for(lambda: plc.read() == now, "the newest values")
        plc.write([1] * 200)
        plc.write(before)  # the one before may have no answer yet
    with opened(entry, 0, 199, mode=Mode.READ) as plc:
        assert plc.read() == before, "closing waits for what was written last"


def test_units_of_one_serial_line_take_turns(rtu):
    entries = {
        "one": device(rtu, 0, **RTU),
        "two": device(rtu, 100, unit=2, **RTU),
        "bits": device(rtu, 0, unit=2, table="coils", **RTU),
        "other": device(rtu, 0, unit=2, **{**RTU, "baud": 9600}),
        "all": device(rtu, 0, unit=0, **RTU),
    }
    with database.using(entries):
        names = ("one", "two", "bits")
        ports = [open_device(x, mode=Mode.READ, wait=Wait.NONE) for x in names]
        got = {name: [] for name in names}

        def cycle():
            for name, port in zip(names, ports, strict=True):
                got[name] += port.read()
            return min(map(len, got.values())) >= 5

        wait_for(cycle, "each is read")
        assert [set(values) for values in got.values()] == [{0}, {700}, {1}]
        with open_device("one", 1, mode=Mode.READ) as waits:
            assert waits.read() == [7]
        for name in ("other", "all"):
            with pytest.raises(DeviceError, match="cannot be reached so"):
                open_device(name, 9, mode=Mode.READ)
        for port in ports:
            port.close()
        open_device("other", mode=Mode.READ).close()  # it is the only one now


@pytest.mark.parametrize(
    ("settings", "how", "told"),
    [
        ({}, {"start": COUNT}, "no such address in this table (code 2)"),
        ({"unit": 9}, {}, "got it has failed (code 4)"),  # as pymodbus says it
        (
            {"table": "input"},
            {"mode": Mode.WRITE},
            "cannot be opened in this direction",
        ),
        (
            {"table": "discrete"},
            {"mode": Mode.RW},
            "cannot be opened in this direction",
        ),
        ({"table": "inputs"}, {}, "a setting of the device is wrong"),
        ({"timeout": 0}, {}, "a setting of the device is wrong"),
        ({}, {"wait": Wait.ONE}, "cannot do this"),
    ],
)
def test_what_cannot_be_is_refused(tcp, settings, how, told):
    entry = device(tcp, **settings)
    with (
        pytest.raises(DeviceError) as caught,
        opened(entry, **({"mode": Mode.READ} | how)) as plc,
    ):
        plc.read()
    assert told in str(caught.value)


def test_a_refusal_leaves_the_device_open(tcp):
    with opened(device(tcp, COUNT - 1), 0, 1, wait=Wait.NONE) as plc:
        for _ in range(2):
            with pytest.raises(DeviceError, match="no such address"):
                wait_for(plc.read, "a refusal")
    entry = device(tcp, COUNT - 1)
    with opened(entry, 0, 1) as plc:
        for _ in range(2):
            with pytest.raises(DeviceError, match="refuses the request"):
                plc.write([1, 2])


def test_a_safe_value_that_is_refused_keeps_no_other_from_the_device(tcp):
    """The last port is none of the device's, which refuses the block."""
    safe = [11, 12, 13, 14]
    with database.using({"plc": device(tcp, COUNT - 3)}):
        plc = open_device("plc", 0, 3, mode=Mode.RW, safe=safe)
        with pytest.raises(DeviceError, match="no such address"):
            plc.close()
    with opened(device(tcp, COUNT - 3), 0, 2) as plc:
        assert plc.read() == safe[:3]
        plc.write([k * 7 & 0xFFFF for k in range(COUNT - 3, COUNT)])


def test_a_device_that_is_silent_is_asked_for_no_more_safe_values(end):
    with database.using({"plc": device(end.address, timeout=0.02, **end.settings)}):
        plc = open_device("plc", 0, 3, mode=Mode.RW, safe=[1, 2, 3, 4])
        end.begin()
        with pytest.raises(DeviceError, match="does not answer"):
            plc.close()
        all_four = len(end.asked())
    assert all_four < 2 * (7 + 6 + 8), "the block, and the first one alone"


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.1:x", "127.0.0.1:1"])
def test_an_address_where_nothing_answers_is_named(address):
    refused = pytest.raises(DeviceError, match="the device cannot be reached")
    with database.using({"plc": device(address)}), refused:
        open_device("plc", mode=Mode.READ)


def test_ports_are_claimed_by_unit_and_table(tcp, monkeypatch):
    entries = {
        "plain": device(tcp),
        "same": device(tcp, unit=1, table="holding"),
        "coils": device(tcp, table="coils"),
        "two": device(tcp, unit=2),
    }
    with database.using(entries), open_device("plain", 3, mode=Mode.READ):
        monkeypatch.chdir("/")  # the address is no file of the current folder
        with pytest.raises(DeviceError, match="a port of the device is taken"):
            open_device("same", 3)
        for other in ("coils", "two"):
            open_device(other, 3).close()
    plain = ModbusSettings()
    assert {k: getattr(plain, k) for k in port_claims.APART} == port_claims.APART


class Scripted:
    """The other end of a line, which is the test: TCP, or a terminal."""

    def __init__(self, kind):
        self.kind = kind
        if kind == "tcp":
            self._server = socket.create_server(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{self._server.getsockname()[1]}"
            self.settings = {}
        else:
            self._fd, slave = os.openpty()
            tty.setraw(slave)
            self.address = os.ttyname(slave)
            os.close(slave)
            self.settings = {"parity": "N"}

    def begin(self):
        """Take the connection, when the device is open."""
        if self.kind == "tcp":
            self._peer, _ = self._server.accept()
            self._fd = self._peer.fileno()

    def asked(self):
        """Return the next request, as the line carries it."""
        return os.read(self._fd, 300)

    def say(self, data):
        os.write(self._fd, data)

    def framed(self, request, data):
        """Return an answer to a request as the line carries it."""
        if self.kind == "tcp":
            return request[:4] + struct.pack(">HB", len(data) + 1, 1) + data
        body = b"\1" + data
        return body + crc(body).to_bytes(2, "little")

    def close(self):
        if self.kind != "tcp":
            os.close(self._fd)
        else:
            self._server.close()
            self._peer.close()


@pytest.fixture(params=["tcp", "rtu"])
def end(request):
    one = Scripted(request.param)
    yield one
    one.close()


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
def test_a_silent_device_is_told_of_and_may_answer_later(end, wait):
    entry = device(end.address, timeout=0.02, **end.settings)
    with opened(entry, wait=wait, mode=Mode.READ) as plc:
        end.begin()
        for _ in range(2):
            with pytest.raises(DeviceError, match="the device does not answer"):
                wait_for(plc.read, "an error")
    entry = device(end.address, timeout=30.0, **end.settings)
    late = end.asked()
    if end.kind == "tcp":
        end._peer.close()
    with opened(entry, wait=Wait.NONE, mode=Mode.READ) as plc:
        end.begin()
        plc.read()
        request = wait_for(lambda: plc.read() or end.asked(), "a request")
        whole = end.framed(request, b"\3\2\x12\x34")
        if end.kind == "tcp":
            number = struct.pack(">H", 0xFFFF)
            end.say(number + end.framed(late, b"\3\2\0\1")[2:])
        for byte in whole:
            assert plc.read() == []
            end.say(bytes((byte,)))
        assert wait_for(plc.read, "the value") == [0x1234]


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
@pytest.mark.parametrize("garbage", [b"\x55", b"\0", b"\1\3\2\xff"])
def test_garbage_ends_in_an_error(end, wait, garbage):
    """All of it is sent, as fast as the device takes it, and nothing hangs."""
    many = garbage * (100_000 // len(garbage))
    entry = device(end.address, timeout=0.02, **end.settings)
    told = "the device (is gone|does not answer|is not open)|does not fit"
    with opened(entry, wait=wait, mode=Mode.READ) as plc:
        end.begin()
        os.set_blocking(end._fd, False)
        errors = []
        while many:
            try:
                many = many[os.write(end._fd, many) :]
            except OSError:
                if errors:
                    break  # it was closed at the first error
            try:
                plc.read()
            except DeviceError as error:
                errors.append(str(error))
        assert all(re.search(told, error) for error in errors)
        assert errors or wait is Wait.NONE
        with pytest.raises(DeviceError, match=told):
            wait_for(plc.read, "an error")


@pytest.mark.parametrize(
    "answer",
    [
        b"\3\4\0\1\0\2",  # two registers
        b"\3\2\0",
        b"\4\2\0\1",
        b"\x83",
        b"\x10\0\0\0\1",
    ],
)
def test_an_answer_that_does_not_fit_is_refused(answer):
    one = Scripted("tcp")
    with opened(device(one.address), wait=Wait.NONE, mode=Mode.READ) as plc:
        one.begin()
        plc.read()
        one.say(one.framed(one.asked(), answer))
        with pytest.raises(DeviceError, match="does not fit the request"):
            wait_for(plc.read, "an error")
        plc.read()  # it is open, and asks again
        one.say(one.framed(one.asked(), b"\x83\6"))
        with pytest.raises(DeviceError, match=r"got it is busy \(code 6\)"):
            wait_for(plc.read, "an error")
    one.close()


def test_reads_and_writes_take_turns():
    one = Scripted("tcp")
    answers = {3: b"\3\2\0\5", 16: b"\x10\0\0\0\1"}
    asked, got = [], []
    with opened(device(one.address), wait=Wait.NONE) as plc:
        one.begin()

        def cycle():
            plc.write([7])
            got.extend(plc.read())
            if select.select([one._fd], [], [], 0)[0]:
                request = one.asked()
                asked.append(request[7])
                one.say(one.framed(request, answers[asked[-1]]))
            return len(asked) >= 6

        wait_for(cycle, "six requests")
        one.close()
    assert asked == [16, 3] * 3
    assert set(got) == {5}


def test_a_damaged_answer_is_refused():
    one = Scripted("rtu")
    entry = device(one.address, timeout=30.0, **one.settings)
    with opened(entry, wait=Wait.NONE, mode=Mode.READ) as plc:
        plc.read()
        whole = one.framed(one.asked(), b"\3\2\0\1")
        one.say(whole[:-1] + bytes((whole[-1] ^ 1,)))
        with pytest.raises(DeviceError, match="does not fit the request"):
            wait_for(plc.read, "an error")
        plc.read()
        wait_for(lambda: select.select([one._fd], [], [], 0)[0] or plc.read(), "ask")
        one.asked()
        one.say(whole)
        assert wait_for(plc.read, "the value") == [1]
    one.close()


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
def test_a_device_that_is_cut_off_is_gone(wait):
    one = Scripted("tcp")
    with opened(device(one.address), wait=wait, mode=Mode.READ) as plc:
        one.begin()
        one.close()
        with pytest.raises(DeviceError, match="the device is gone"):
            wait_for(plc.read, "an error")
        with pytest.raises(DeviceError, match="the device is not open"):
            plc.read()


def test_a_line_that_was_unplugged_is_opened_anew():
    ends = [Scripted("rtu"), Scripted("rtu")]
    entries = {"a": device(ends[0].address, **ends[0].settings)}
    entries["b"] = device(ends[0].address, unit=2, **ends[0].settings)
    with database.using(entries):
        a, b = (open_device(x, mode=Mode.READ) for x in "ab")
        ends[0].close()
        with pytest.raises(DeviceError, match="the device is gone"):
            a.read()
        with pytest.raises(DeviceError, match="cannot be opened"):
            open_device("a", mode=Mode.READ)  # and not the line that hung up
        b.close()
    ends[1].close()


def test_what_was_read_replays_without_a_device(tcp):
    def run():
        with open_device("plc", 1, 3, mode=Mode.RW, safe=None, wait=Wait.NONE) as plc:
            found = []
            wait_for(lambda: found.append(plc.read()) or found[-1], "the values")
            plc.write([1, 2, 3])
        with open_device("plc", 1, 2, mode=Mode.READ) as plc:
            found.append(plc.read())
        with open_device("strange", 0, mode=Mode.READ) as plc:
            with pytest.raises(DeviceError) as caught:
                plc.read()
            found.append(str(caught.value))
        return found

    tape = Tape()
    entries = {"plc": device(tcp, 900), "strange": device(tcp, COUNT)}
    with database.using(entries), recording(tape):
        first = run()
    assert first[-3:-1] == [[6307, 6314, 6321], [1, 2]]
    player = Player()
    player.feed(tape.take())
    with database.using({}), no_devices("this is a replay"), recording(player):
        assert run() == first
