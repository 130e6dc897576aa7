"""Devices by logical names: what is checked at open, claims, and the first drivers."""

from __future__ import annotations

import fcntl
import functools
import os
import random
import signal
import socket
import subprocess
import sys
import termios
import tty
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from watching import wait_for

from pbonet.errors import DeviceError, DeviceTakenError
from pbonet.io import no_devices
from pbonet.io.drivers import (
    Entry,
    Mode,
    Opening,
    PortDevice,
    Wait,
    database,
    listed,
    open_device,
    port_claims,
)
from pbonet.io.drivers.device_classes import convert
from pbonet.io.drivers.serial_driver import SioParam
from pbonet.master.tools import device_owners
from pbonet.node.rtpu import cleanup
from pbonet.outside import Outside, Player, Tape, using as recording
from pbonet.xm.net import run_folder

HOLDS = """
import sys, time
from pbonet.io.drivers import Entry, Mode, database, open_device
database.use({"m": Entry(driver="file", address=sys.argv[1], ports=8)}, "arm9/x")
kept = [open_device("m", port, mode=Mode.READ) for port in (2, 3)]
print("open", flush=True)
time.sleep(600)
"""


@pytest.fixture(autouse=True)
def run_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))


@pytest.fixture
def devices(tmp_path):
    """A file of 64 bytes as `m`, with 8 ports, and a terminal as `line`."""
    file = tmp_path / "memory"
    file.write_bytes(bytes(range(64)))
    master, slave = os.openpty()
    tty.setraw(master)
    name = os.ttyname(slave)
    os.close(slave)
    entries = {
        "m": Entry(driver="file", address=str(file), ports=8),
        "high": Entry(driver="file", address=str(file), first=4, ports=4),
        "line": Entry(driver="serial", address=name, settings={"baud": 19200}),
        "tcp": Entry(driver="tcp", address="localhost:1", settings={"listen": 1}),
        "strange": Entry(driver="abacus", address="x"),
        "wrong": Entry(driver="serial", address=name, settings={"boud": 9600}),
        "gone": Entry(driver="serial", address=str(tmp_path / "ttyUSB7")),
    }
    with database.using(entries, "arm0/reads"):
        ends = {"file": file, "master": master}
        yield ends
    os.close(ends["master"])


@pytest.mark.parametrize(
    ("what", "told"),
    [
        ({"name": "n"}, "there is no device n on this machine"),
        ({"name": "lime"}, "did you mean line?"),
        ({"name": "strange"}, "there is no driver abacus"),
        ({"name": "wrong"}, "boud"),
        ({"name": "gone", "mode": Mode.RW, "safe": None}, "No such file"),
        ({"name": "m", "start": 8}, "the device has no such ports"),
        ({"name": "m", "start": -1}, "the device has no such ports"),
        ({"name": "m", "start": 1, "end": 2}, "one of 0 to 7"),
        ({"name": "line", "start": 1}, "one of 0 to 0"),
        ({"name": "tcp", "mode": Mode.RW}, "listen"),
        ({"name": "m", "wait": Wait.NONE}, "got wait none"),
        ({"name": "m", "size": 12}, "got size 12"),
        ({"name": "m", "trunc_lsb": True}, "got trunc_lsb"),
    ],
)
@pytest.mark.usefixtures("devices")
def test_what_cannot_be_is_refused_at_open(what, told):
    with pytest.raises(DeviceError) as caught:
        open_device(**what)
    assert told in str(caught.value)
    assert list(port_claims.users(database.entry("m"), range(8))) == []


@pytest.mark.usefixtures("devices")
def test_a_port_has_one_user():
    with open_device("m", 5, mode=Mode.READ):
        with pytest.raises(DeviceError, match="a port of the device is taken") as one:
            open_device("m", 5)
        assert f"port 5: arm0/reads (process {os.getpid()})" in str(one.value)
        with pytest.raises(DeviceError, match="a port of the device is taken"):
            open_device("high", 1)  # the same physical port
        open_device("high", 2).close()
    open_device("m", 5).close()


def test_a_device_has_one_user_by_whichever_path_it_is_named(devices, monkeypatch):
    link = devices["file"].with_name("link")
    link.symlink_to(devices["file"])
    other = {
        "n": Entry(driver="file", address=str(link), ports=8),
        "m": database.entry("m"),
    }
    taken = pytest.raises(DeviceError, match="a port of the device is taken")
    with database.using(other), open_device("m", 5, mode=Mode.READ), taken:
        open_device("n", 5)
    can = Entry(driver="can", address="vcan7")
    chosen = Opening(
        "c", *(0, 0), Mode.READ, Wait.NONE, 8, signed=False, trunc_lsb=False
    )
    claim = port_claims.claim(can, chosen)
    monkeypatch.chdir(devices["file"].parent)  # a name of an interface is no path
    with pytest.raises(DeviceError, match="a port of the device is taken"):
        port_claims.claim(can, chosen)
    claim.release()


def test_the_ports_of_a_killed_process_are_free(devices):
    other = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(devices["file"])],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert other.stdout.readline() == "open\n"
        (two, three) = port_claims.users(database.entry("m"), range(8))
        assert (two.port, two.owner, two.mode, two.pid) == (
            *(2, "arm9/x", Mode.READ), other.pid
        )  # fmt: skip
        with pytest.raises(DeviceError, match="arm9/x"):
            open_device("m", three.port)
    finally:
        other.send_signal(signal.SIGKILL)
        other.communicate()
    open_device("m", 3).close()


@pytest.mark.usefixtures("devices")
def test_a_task_that_is_refused_a_port_waits_for_it_and_a_program_does_not():
    with open_device("m", 1) as first, open_device("m", 2) as other:
        with database.using(kept("m")), pytest.raises(DeviceError, match="m") as caught:
            open_device("m", 1)
        assert not isinstance(caught.value, DeviceTakenError)
        assert not first.is_wanted()
        with pytest.raises(DeviceTakenError, match="swap the tasks"):
            open_device("m", 1)
        assert (first.is_wanted(), other.is_wanted()) == (True, False)
    with open_device("m", 1) as second:
        assert not second.is_wanted()


WAITS = """
import sys, time
from pbonet.errors import DeviceTakenError
from pbonet.io.drivers import Entry, database, open_device
database.use({"m": Entry(driver="file", address=sys.argv[1], ports=8)}, "arm9/x")
try:
    open_device("m", 1)
except DeviceTakenError:
    print("refused", flush=True)
time.sleep(600)
"""


def test_a_task_that_has_ended_waits_for_no_port(devices):
    command = [sys.executable, "-c", WAITS, devices["file"]]
    with open_device("m", 1) as first:
        with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
            assert other.stdout.readline() == b"refused\n"
            assert first.is_wanted()
            other.kill()
        assert not first.is_wanted()


def test_devices_are_listed_with_their_last_errors(devices):
    assert listed(kept("m"))[0].fault is None
    with open_device("m", 1, mode=Mode.READ) as m:
        os.truncate(devices["file"], 2)
        with pytest.raises(DeviceError):
            m.read(64)
        found = listed(kept("m"))[0].fault
        assert "m (" in found.text
        assert (found.task, found.age >= 0.0) == ("arm0/reads", True)
        with pytest.raises(DeviceError):
            open_device("gone", mode=Mode.READ)
        assert "No such file" in listed(kept("gone"))[0].fault.text


def test_devices_are_listed_with_the_users_of_their_ports(devices):
    whole = {"all": Entry(driver="file", address=str(devices["file"]))}
    names = "m", "high", "line"
    with open_device("m", 6, mode=Mode.RW, safe=None), open_device("m", 1):
        found = {one.name: one for one in listed({**kept(*names), **whole})}
    assert [*found] == ["all", "high", "line", "m"]
    assert [one.kind for one in found.values()] == ["MEM", "MEM", "SIO", "MEM"]
    assert (found["high"].first, found["high"].ports) == (4, 4)
    one, six = found["all"].users
    pid = os.getpid()
    assert (one.port, one.task, one.mode, one.pid) == (1, "arm0/reads", "NONE", pid)
    assert (six.port, six.task, six.mode, six.pid) == (6, "arm0/reads", "RW", pid)
    assert found["m"].users == [one, six]
    assert [user.port for user in found["high"].users] == [2]
    assert found["line"].users == []
    (foreign,) = listed({"x": Entry(driver="their.package:Driver", address="y")})
    assert (foreign.driver, foreign.kind) == ("their.package:Driver", "")
    assert [user for one in listed(whole) for user in one.users] == []


def kept(*names):
    return {name: database.entry(name) for name in names}


def test_many_ports_of_several_openings_are_found_in_order():
    entry = Entry(driver="file", address="/dev/null", first=3)
    spans = [(9, 12), (0, 2), (40, 40), (65_000, 65_532)]
    chosen = [
        Opening("x", begin, end, Mode.READ, Wait.ALL, 32, signed=False, trunc_lsb=False)
        for begin, end in spans
    ]
    claims = [port_claims.claim(entry, one) for one in chosen]
    (found,) = listed({"x": entry})
    for one in claims:
        one.release()
    assert [one.port for one in found.users] == [
        port for begin, end in sorted(spans) for port in range(begin, end + 1)
    ]


@pytest.mark.usefixtures("devices")
def test_the_file_of_a_device_is_removed_when_nothing_has_it_open():
    folder = run_folder.claims()
    with open_device("m", 1):
        cleanup.sweep_claims()
        with (
            database.using(kept("m")),  # a program, which waits for no port
            pytest.raises(DeviceError, match="arm0/reads"),
        ):
            open_device("m", 1)
    assert len([*folder.iterdir()]) == 1
    cleanup.sweep_claims()
    assert [*folder.iterdir()] == []
    open_device("m", 1).close()


@pytest.mark.usefixtures("devices")
def test_a_claim_waits_for_the_removal_of_the_file_and_makes_another():
    entry = database.entry("m")
    open_device("m", 1).close()
    (path,) = run_folder.claims().iterdir()
    fd = os.open(path, os.O_RDWR)
    fcntl.flock(fd, fcntl.LOCK_EX)
    with ThreadPoolExecutor(1) as pool:
        opened = pool.submit(open_device, "m", 1)
        waits = f"-> FLOCK  ADVISORY  READ {os.getpid()} "
        wait_for(lambda: waits in Path("/proc/locks").read_text(), "the claim")
        path.unlink()
        os.close(fd)
        with opened.result():
            assert [one.port for one in port_claims.users(entry, range(8))] == [1]


@pytest.mark.usefixtures("devices")
def test_a_runtime_folder_that_takes_no_claims_is_told():
    (run_folder.folder() / "devices").write_text("")
    with pytest.raises(DeviceError, match="the ports of the device cannot be claimed"):
        open_device("m", 1)


def test_a_task_without_devices_loads_no_driver():
    code = "import sys, pbonet.node.task.task_process; print([*sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "pbonet.config" in done.stdout
    assert "'pbonet.io" not in done.stdout


def test_memory_is_read_written_mapped_and_guarded(devices):
    with open_device("m", 0, mode=Mode.RW, safe=None) as m:
        assert m.read(3, at=61) == bytes((61, 62, 63))
        assert m.write(b"ab", at=4) == 2
        assert m.mmap()[4:6] == b"ab"
        with pytest.raises(DeviceError, match="no such bytes"):
            m.read(4, at=61)
        os.truncate(devices["file"], 16)
        with pytest.raises(DeviceError, match="the device is gone"):
            m.read(1)
        with pytest.raises(DeviceError, match="the device is not open"):
            m.read(1)
    open_device("m", 0).close()  # it gave its port back


@pytest.mark.usefixtures("devices")
def test_directions_are_kept():
    with open_device("m", 0, mode=Mode.READ) as m:
        with pytest.raises(DeviceError, match="not open in this direction"):
            m.write(b"a")
        assert m.status("PORTNUM") == 8
        with pytest.raises(DeviceError, match="no command SIO_GET"):
            m.status("SIO_GET")


@pytest.mark.parametrize(
    ("wait", "there", "asked", "got"),
    [
        (Wait.NONE, b"", 4, b""),
        (Wait.NONE, b"ab", 4, b"ab"),
        (Wait.NOALL, b"ab", 4, b""),
        (Wait.NOALL, b"abcde", 4, b"abcd"),
        (Wait.ONE, b"ab", 4, b"ab"),
        (Wait.ALL, b"abcde", 4, b"abcd"),
    ],
)
def test_a_line_waits_as_it_was_opened(devices, wait, there, asked, got):
    with open_device("line", mode=Mode.RW, safe=None, wait=wait) as line:
        os.write(devices["master"], there)
        fd = line._line.fileno()
        wait_for(lambda: waiting(fd) == len(there), "the bytes")
        assert line.read(asked) == got
        if len(got) < len(there):
            os.write(devices["master"], b"xyz")
            rest = there[len(got) :] + b"xyz"
            wait_for(lambda: waiting(fd) >= 3, "more bytes")
            assert line.read(len(rest)) == rest


def waiting(fd):
    return int.from_bytes(fcntl.ioctl(fd, termios.FIONREAD, bytes(4)), "little")


def test_a_line_is_set_and_lost(devices):
    with open_device("line", mode=Mode.RW, safe=None, wait=Wait.NONE) as line:
        assert line.status("SIO_GET") == SioParam(19200, 8, 1, "N")
        line.control("SIO_SET", SioParam(9600, 7, 2, "E"))
        assert line.status("SIO_GET").baud == 9600
        with pytest.raises(DeviceError):
            line.control("SIO_SET", SioParam(9600, 7, 2, "?"))
        assert line.status("SIO_GET").parity == "E", "it works as before"
        os.close(devices["master"])
        with pytest.raises(DeviceError, match="the device is gone"):
            line.read(1)
    devices["master"] = os.dup(0)


def test_lines_over_a_network():
    server = socket.create_server(("127.0.0.1", 0))
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    other.bind(("127.0.0.1", 0))
    entries = {
        "tcp": Entry(driver="tcp", address=f"127.0.0.1:{server.getsockname()[1]}"),
        "udp": Entry(driver="udp", address=f"127.0.0.1:{other.getsockname()[1]}"),
    }
    with server, other, database.using(entries):
        with open_device("tcp", mode=Mode.RW, safe=None) as tcp:
            peer, _ = server.accept()
            assert tcp.write(b"ask") == 3
            assert peer.recv(9) == b"ask"
            peer.sendall(b"answer")
            assert tcp.read(9)[:1] == b"a"
            peer.close()
            with pytest.raises(DeviceError, match="the device is gone"):
                [tcp.read(9) for _ in range(9)]
        server.close()
        with pytest.raises(DeviceError, match="the device cannot be reached"):
            open_device("tcp", mode=Mode.RW, safe=None)
        with open_device("udp", mode=Mode.RW, safe=None, wait=Wait.ALL) as udp:
            udp.write(b"ask")
            data, where = other.recvfrom(9)
            assert data == b"ask"
            other.sendto(b"one", where)
            other.sendto(b"two", where)
            assert udp.read(4) == b"onet"
            assert udp.read(2) == b"wo"
            other.close()  # no program listens there now: that is no loss
            for _ in range(3):
                assert udp.write(b"again") == 5


@pytest.mark.parametrize("driver", ["serial", "tcp", "udp"])
def test_garbage_passes_through_a_line_and_nothing_hangs(devices, driver):
    """A hundred thousand bytes, as fast as the line takes them."""
    many = random.Random(driver).randbytes(100_000)
    with (
        far_end(driver, devices) as (entry, send),
        database.using({"x": entry}),
        open_device("x", mode=Mode.RW, wait=Wait.NONE, safe=None) as line,
    ):
        line.write(b"begin")
        give = send()
        found = b""
        for k in range(0, len(many), 1000):
            give(many[k : k + 1000])
            while len(found) < k + 1000:
                found += line.read(4096)
    assert found == many


@contextmanager
def far_end(driver, devices):
    """Give the entry of a line, and what returns a function that sends to it."""
    if driver == "serial":
        give = functools.partial(os.write, devices["master"])
        yield database.entry("line"), lambda: give
    elif driver == "tcp":
        with socket.create_server(("127.0.0.1", 0)) as server, ExitStack() as stack:
            where = f"127.0.0.1:{server.getsockname()[1]}"

            def accept():
                return stack.enter_context(server.accept()[0]).sendall

            yield Entry(driver="tcp", address=where), accept
    else:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.1", 0))

            def send():
                where = other.recvfrom(9)[1]
                return lambda data: other.sendto(data, where)

            where = f"127.0.0.1:{other.getsockname()[1]}"
            yield Entry(driver="udp", address=where), send


def test_what_was_read_replays_without_a_device(devices):
    def run():
        with open_device("m", 1, mode=Mode.READ) as m:
            found = [m.read(2, at=at) for at in (3, 9)]
        with open_device("line", mode=Mode.READ, wait=Wait.ALL) as line:
            if not line.outside.plays:
                os.write(devices["master"], b"hello")
            found.append(line.read(5))
        with pytest.raises(DeviceError) as caught:
            open_device("gone", mode=Mode.READ)
        return [*found, str(caught.value)]

    tape = Tape()
    with recording(tape):
        first = run()
    assert first[:3] == [b"\3\4", b"\t\n", b"hello"]
    devices["file"].unlink()
    player = Player()
    player.feed(tape.take())
    with database.using({}), no_devices("this is a replay"), recording(player):
        assert run() == first


def test_a_simulation_opens_none(devices):
    told = r"this is a simulation\); put the module that simulates it in its place"
    refused = pytest.raises(DeviceError, match=told)
    with no_devices("this is a simulation"), refused:
        open_device("m", 0, mode=Mode.READ)
    assert not (devices["file"].parent / "run" / "devices").exists()


@pytest.mark.parametrize(
    ("value", "bits", "size", "how", "result"),
    [
        (0xABC, 12, 16, "", 0xABC),
        (0xABC, 12, 8, "", 0xBC),
        (0xABC, 12, 8, "trunc_lsb", 0xAB),
        (0xABC, 12, 16, "signed", 0xFABC - 0x10000),
        (0x7BC, 12, 32, "signed", 0x7BC),
        (0xFFF, 12, 8, "signed", -1),
        (-2, 16, 12, "", 0xFFE),
        (1, 1, 32, "signed", 1),
    ],
)
def test_sizes_are_converted(value, bits, size, how, result):
    told = {"signed": how == "signed", "trunc_lsb": how == "trunc_lsb"}
    assert convert(value, bits, size, **told) == result


class Ports(PortDevice):
    """Four ports of 12 bits that keep what is written."""

    kind = "ADC"

    def connect(self):
        self.values = [1, 2, 3]

    def disconnect(self):
        pass

    def port_bits(self, _port):
        return 12

    def read_ports(self):
        return self.values

    def write_ports(self, values):
        self.values = list(values)


def test_ports_pass_elements_of_the_chosen_size():
    chosen = Opening("p", 1, 3, Mode.RW, Wait.ALL, 16, signed=True, trunc_lsb=False)
    ports = Ports(Entry(driver="x", address="", ports=4), chosen, Outside("p"))
    ports.open(None)
    assert ports.read() == [1, 2, 3]
    ports.write([-1, 0x1234, 7])
    assert ports.values == [0xFFF, 0x234, 7]
    assert ports.read() == [-1, 0x234, 7]
    with pytest.raises(DeviceError, match="a value for each opened port"):
        ports.write([1])
    assert ports.status("PORTSIZE", 2) == 12


def test_devices_are_shown_with_their_tasks():
    user = {"port": 3, "task": "arm0/reads", "mode": "READ", "pid": 7}
    mem = {
        "rtpu": "arm0",
        "host": "a",
        "name": "mem",
        "driver": "file",
        "kind": "MEM",
        "address": "x",
        "ports": 8,
        "users": [user, {**user, "port": 4, "task": ""}],
    }
    fault = {"text": "it is gone", "task": "arm0/reads", "age": 6.7}
    theirs = {**mem, "kind": "", "ports": 0, "users": [], "fault": fault}
    assert [*device_owners.lines([mem, theirs])] == [
        "arm0 (a) mem: MEM, file x, 8 ports",
        "  port 3: READ arm0/reads, process 7",
        "  port 4: READ a program, process 7",
        "arm0 (a) mem: class ?, file x",
        "  last error, 7 s ago, arm0/reads: it is gone",
    ]
