"""Safe values: written when a device is closed, its task is not ON, or is gone."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Annotated as A

import pytest
from watching import processes_of, wait_for

from pbonet import InVar, OutVar, PortBasedObject
from pbonet.errors import DeviceError, MethodError
from pbonet.io import no_devices
from pbonet.io.drivers import (
    GUARD,
    Entry,
    Frame,
    Mode,
    Wait,
    database,
    device,
    guard,
    open_device,
    port_claims,
)
from pbonet.outside import Player, Tape, using as recording
from pbonet.testing import Bench

SAFE = {2: b"\x00\x07"}


@pytest.fixture
def file(tmp_path, monkeypatch):
    """A file of 16 bytes of 255, and devices: it, an address, a CAN bus."""
    path = tmp_path / "memory"
    path.write_bytes(b"\xff" * 16)
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path))
    tmp_path.chmod(0o700)
    can = {"interface": "virtual"}
    entries = {
        "m": Entry(driver="file", address=str(path), ports=4),
        "dac": Entry(driver="iio_dac", address=str(tmp_path / "dac")),
        "udp": Entry(driver="udp", address="127.0.0.1:9"),
        "can": Entry(driver="can", address="safe", settings=can),
    }
    (tmp_path / "dac").mkdir()
    for k in range(2):
        (tmp_path / "dac" / f"out_voltage{k}_raw").write_text("0\n")
    with database.using(entries, "arm0/acts"):
        yield path


def of(file):
    return file.read_bytes()[2:4]


def guarded():
    """Return the taken ports, but for one that is left as it is: a copy may have it."""
    users = port_claims.users(database.entry("m"), range(4))
    return [one.port for one in users if one.port != 2]


@pytest.mark.parametrize(
    ("what", "told"),
    [
        ({"name": "m", "mode": Mode.WRITE}, "safe=VALUES, as write() takes them, or"),
        ({"name": "m", "mode": Mode.RW}, "safe=None"),
        ({"name": "m", "safe": SAFE}, "a device that is not written has no safe"),
        ({"name": "m", "mode": Mode.RW, "safe": b"0"}, "expected bytes by offset"),
        ({"name": "m", "mode": Mode.RW, "safe": {15: b"00"}}, "got 15 to 16"),
        ({"name": "dac", "mode": Mode.WRITE, "safe": [0, 0]}, "expected 1, got 2"),
        ({"name": "dac", "mode": Mode.WRITE, "safe": ["x"]}, "a number for each port"),
        ({"name": "udp", "mode": Mode.RW, "safe": [1]}, "expected bytes"),
        ({"name": "can", "mode": Mode.RW, "safe": [1]}, "expected a list of Frame"),
        ({"name": "can", "mode": Mode.RW, "safe": [Frame(4096)]}, "0 to 7FFh"),
    ],
)
@pytest.mark.usefixtures("file")
def test_what_cannot_be_safe_is_refused_at_open(what, told):
    with pytest.raises(DeviceError) as caught:
        open_device(**what)
    assert told in str(caught.value)
    entry = database.entry(what["name"])
    assert list(port_claims.users(entry, range(4))) == []


def test_a_device_that_is_closed_has_its_safe_values(file):
    with open_device("m", mode=Mode.RW, safe=SAFE) as m:
        m.write(b"\x01" * 16)
    assert file.read_bytes() == b"\x01\x01\x00\x07" + b"\x01" * 12
    with open_device("m", mode=Mode.RW, safe=None) as m:
        m.write(b"\x02" * 16)
    assert file.read_bytes() == b"\x02" * 16


def test_safe_values_are_written_whole_also_where_no_call_waits(file):
    frames = [Frame(1, b"a"), Frame(2, b"b")]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far:
        far.bind(("127.0.0.1", 0))
        far.settimeout(60.0)
        where = f"127.0.0.1:{far.getsockname()[1]}"
        entries = {
            "udp": Entry(driver="udp", address=where),
            "can": database.entry("can"),
        }
        with (
            database.using(entries),
            open_device("can", 1, mode=Mode.READ, wait=Wait.ALL) as heard,
        ):
            open_device("udp", mode=Mode.WRITE, wait=Wait.NONE, safe=b"stop").close()
            open_device("can", mode=Mode.WRITE, wait=Wait.NONE, safe=frames).close()
            assert far.recv(64) == b"stop"
            assert [one[:2] for one in heard.read(2)] == [(1, b"a"), (2, b"b")]
    assert of(file) == b"\xff\xff"


def test_safe_values_do_not_wait_without_end_for_a_device_that_takes_no_more(
    monkeypatch, tmp_path
):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path))
    monkeypatch.setattr(device, "PATIENCE", 0.01)
    tmp_path.chmod(0o700)
    with socket.create_server(("127.0.0.1", 0)) as server:
        where = f"127.0.0.1:{server.getsockname()[1]}"
        with database.using({"line": Entry(driver="tcp", address=where)}):
            line = open_device("line", mode=Mode.RW, wait=Wait.NONE, safe=b"stop")
            for piece in (b"\0" * 65536, b"\0"):
                while line.write(piece):
                    pass  # nobody reads
            with pytest.raises(DeviceError, match="timed out"):
                line.close()


class Acts(PortBasedObject):
    """Writes 255 to its device in each method; raises when it is told."""

    y: A[float, OutVar("Y", "1", "none", "cycles")]
    fails: str = ""

    def init(self) -> None:
        self.memory = open_device("m", mode=Mode.RW, safe=SAFE)
        self.acts("init")

    def acts(self, method: str) -> None:
        self.memory.write(b"\xff\xff", 2)
        if self.fails == method:
            raise ValueError(method)

    def on(self) -> None:
        self.acts("on")

    def cycle(self, dt: float) -> None:
        del dt
        self.acts("cycle")

    def off(self) -> None:
        self.acts("off")

    def kill(self) -> None:
        self.acts("kill")


@pytest.mark.parametrize(
    ("how", "state"),
    [
        ("off", "OFF"),
        ("off fails", "ERROR"),
        ("kill", "NOT-CREATED"),
        ("kill fails", "NOT-CREATED"),
        ("cycle fails", "ERROR"),
    ],
)
def test_a_task_that_is_not_on_has_safe_values(file, how, state):
    """The module itself writes something else in every method."""
    with Bench(Acts) as bench:
        assert of(file) == b"\x00\x07"  # after init
        bench.on()
        bench.step()
        assert of(file) == b"\xff\xff"
        signal_name, _, fails = how.partition(" ")
        bench.module.fails = signal_name if fails else ""
        with suppress(MethodError):
            if signal_name == "cycle":
                bench.executor.cycle(0.01)
            else:
                bench.executor.signal(signal_name)
        assert bench.executor.state == state
        assert of(file) == b"\x00\x07"
        assert bool(list(port_claims.users(database.entry("m"), range(4)))) == (
            state != "NOT-CREATED"
        )


def test_an_on_that_fails_leaves_safe_values(file):
    with Bench(Acts) as bench:
        bench.module.fails = "on"
        with pytest.raises(MethodError):
            bench.on()
        assert of(file) == b"\x00\x07"


class Quiet(PortBasedObject):
    """Writes its port's number to its byte in each cycle, and does no more."""

    y: A[float, OutVar("Y", "1", "none", "cycles")]
    port: int = 0

    def init(self) -> None:
        at = 2 + self.port
        self.memory = open_device("m", self.port, mode=Mode.RW, safe={at: b"\0"})

    def cycle(self, dt: float) -> None:
        del dt
        self.memory.write(bytes((self.port + 1,)), 2 + self.port)


class Second(Quiet):
    """The same at another port."""

    port = 1


def test_one_task_makes_only_its_own_devices_safe(file):
    with Bench(Quiet) as first, Bench(Second) as second:
        for bench in (first, second):
            bench.on()
            bench.step()
        assert of(file) == b"\1\2"
        first.executor.signal("off")
        assert of(file) == b"\0\2"
        second.executor.signal("off")
        assert of(file) == b"\0\0"


@pytest.mark.parametrize(
    ("order", "state"), [("off", "ERROR"), ("kill", "NOT-CREATED")]
)
def test_an_order_whose_safe_values_cannot_be_written_fails(file, order, state):
    with Bench(Quiet) as bench:
        bench.on()
        bench.step()
        os.truncate(file, 2)
        with pytest.raises(MethodError, match="the device is gone"):
            bench.executor.signal(order)
        assert bench.executor.state == state
        told = [str(one) for one in bench.notices()]
        assert any("the safe values were not written" in one for one in told)


class Bad(Quiet):
    """Its device raises what no driver should."""

    def init(self) -> None:
        super().init()
        self.first = open_device("m", 1, mode=Mode.RW, safe={4: b"\0"})

    def kill(self) -> None:
        def fail() -> None:
            raise ValueError("a driver of somebody")

        self.memory.check = fail
        self.memory.write = self.memory.disconnect = lambda *_: fail()


def test_a_driver_that_raises_anything_keeps_no_other_device_from_being_safe(file):
    with Bench(Bad) as bench:
        bench.on()
        bench.module.first.write(b"\1", 4)
        with pytest.raises(MethodError, match="a driver of somebody"):
            bench.executor.signal("kill")
        assert bench.executor.state == "NOT-CREATED"
    assert file.read_bytes()[4] == 0
    assert not list(port_claims.users(database.entry("m"), range(4)))


class Follows(PortBasedObject):
    """Writes what it reads; while that is too old, its device is safe."""

    u: A[float, InVar("U", "1", "none", "command", max_age=0.05, stale="safe")]
    y: A[float, OutVar("Y", "1", "none", "command", new=True, safe=0.0)]

    def init(self) -> None:
        self.memory = open_device("m", mode=Mode.RW, safe=SAFE)

    def cycle(self, dt: float) -> None:
        del dt
        self.memory.write(bytes((int(self.u), 9)), 2)


def test_a_device_is_safe_while_the_controller_is_lost(file):
    with Bench(Follows, {"u": 5.0}) as bench:
        bench.ages["u"] = 0.0
        bench.on()
        bench.step()
        assert of(file) == b"\x05\x09"
        bench.ages["u"] = 1.0
        bench.step()
        assert of(file) == b"\x00\x07"
        assert bench.executor.state == "ON"


PROGRAM = """
import os, sys, time
from pbonet.io.drivers import Entry, Mode, database, guard, open_device
how, path = sys.argv[1:]
with database.using({"m": Entry(driver="file", address=path, ports=4)}, "arm0/acts"):
    kept = open_device("m", mode=Mode.RW, safe={2: b"\\0\\7"})
    other = open_device("m", 1, mode=Mode.RW, safe={12: b"\\5"})
    left = open_device("m", 2, mode=Mode.RW, safe=None)
    for one in (kept, other, left):
        one.write(b"\\1" * 16)
    if how == "closed":
        other.close()
        other = open_device("m", 1, mode=Mode.RW, safe=None)
        other.write(b"\\1" * 16)
    if how == "replaced":  # what the first one knew is guarded by nobody
        os.kill(guard.guard().pid, 9)
        os.waitpid(guard.guard().pid, 0)
        new = open_device("m", 3, mode=Mode.RW, safe={8: b"\\6"})
        kept.close()
        new.write(b"\\1" * 16)
    if how == "lost":  # it did not answer in time, and still lives
        guard.lose()
        other.close()
    if how == "copied":
        if not (copy := os.fork()):
            kept.close()
            os._exit(0)
        os.waitpid(copy, 0)
        kept.write(b"\\1" * 16)
    if how == "forked" and not os.fork():
        time.sleep(60)
    print("ready", flush=True)
    sys.stdin.readline()
    if how == "ends":
        sys.exit(0)
"""


PORTS = {"replaced": [1, 3]}
MADE_SAFE = {"closed": {2: 0, 3: 7}, "replaced": {8: 6}}
"""The bytes that are safe afterwards, where it is not those of both devices."""


@pytest.mark.parametrize(
    "how", ["killed", "closed", "forked", "ends", "group", "replaced", "copied"]
)
def test_a_process_that_is_gone_leaves_safe_values_and_free_ports(file, how):
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, how, str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout.readline() == "ready\n"
        assert guarded() == PORTS.get(how, [0, 1])
        assert of(file) == b"\x01\x01"
        try:
            if how == "ends":
                process.stdin.write("\n")
                process.stdin.flush()
            elif how == "group":
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
            process.stdout.close()
            wait_for(lambda: not guarded(), "the ports free")
        finally:
            os.killpg(process.pid, signal.SIGKILL)
    written = bytearray(b"\x01" * 16)
    for at, value in MADE_SAFE.get(how, {2: 0, 3: 7, 12: 5}).items():
        written[at] = value
    assert file.read_bytes() == bytes(written)


def test_a_device_that_does_not_answer_is_tried_again(file, tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "killed", str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "ready\n"
        file.rename(tmp_path / "elsewhere")
        process.kill()
        process.wait()
        entry = database.entry("m")
        assert list(port_claims.users(entry, range(2))), "it has not given up"
        (tmp_path / "elsewhere").rename(file)
        wait_for(lambda: of(file) == b"\x00\x07", "safe values")


def test_a_guard_that_was_given_up_leaves_alone_what_others_have_opened(file):
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "lost", str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "ready\n"
        with open_device("m", 1, mode=Mode.RW, safe=None) as other:
            other.write(b"\1" * 16)
            assert len(processes_of(GUARD, str(process.pid))) == 1
            process.kill()
            wait_for(
                lambda: not processes_of(GUARD, str(process.pid)),
                "the end of the guard",
            )
    assert file.read_bytes() == b"\1\1\0\7" + b"\1" * 12


def test_a_port_whose_user_has_ended_is_waited_for(file, tmp_path):
    """A task that comes back opens its device while the guard still has it."""
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "killed", str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "ready\n"
        with pytest.raises(DeviceError, match=f"process {process.pid}"):
            open_device("m", mode=Mode.RW, safe=None)
        file.rename(tmp_path / "elsewhere")  # the guard has it until it is there
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it stays a zombie
        back = threading.Timer(0.1, (tmp_path / "elsewhere").rename, [file])
        back.start()
        with open_device("m", mode=Mode.RW, safe=None):
            assert of(file) == b"\x00\x07"
        back.join()


def test_a_guard_that_was_killed_is_replaced(file):
    with open_device("m", mode=Mode.RW, safe=SAFE):
        first = guard.guard().pid
        os.kill(first, signal.SIGKILL)
        os.waitpid(first, 0)
    with open_device("m", mode=Mode.RW, safe=SAFE):
        assert guard.guard().pid != first
        environ = Path(f"/proc/{guard.guard().pid}/environ").read_bytes()
        assert f"{GUARD}={os.getpid()}".encode() in environ.split(b"\0")
    assert of(file) == b"\x00\x07"


@pytest.mark.usefixtures("file")
def test_where_there_can_be_no_guard_nothing_is_opened(monkeypatch):
    guard.lose()
    monkeypatch.setattr(sys, "executable", "/no/python")
    with pytest.raises(DeviceError, match="no process can guard the device"):
        open_device("m", mode=Mode.RW, safe=SAFE)
    assert not list(port_claims.users(database.entry("m"), range(4)))


def test_a_replay_starts_no_guard_and_repeats_that_there_was_none(file, monkeypatch):
    """The first opening has one, the second is refused, as the record says."""

    def run():
        open_device("m", mode=Mode.RW, safe=SAFE).close()
        with monkeypatch.context() as here:
            here.setattr(sys, "executable", "/no/python")
            guard.lose()
            with pytest.raises(DeviceError) as caught:
                open_device("m", mode=Mode.RW, safe=SAFE)
        return str(caught.value)

    tape, player = Tape(), Player()
    with recording(tape):
        first = run()
    file.unlink()
    player.feed(tape.take())
    monkeypatch.setattr(guard, "watch", None)
    with no_devices("this is a replay"), recording(player):
        assert run() == first
