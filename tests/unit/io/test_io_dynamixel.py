"""Servos on a serial line: against servos at the other end of a terminal."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys

import msgspec
import pytest
from device_rigs import Dynamixel
from watching import wait_for

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, Wait, database, listed, open_device
from pbonet.io.drivers.dynamixel_driver import packet

TORQUE, GOAL, POSITION = 0, 2, 4
"""The first port of each register, of two servos."""


@pytest.fixture
def rig(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    one = Dynamixel(monkeypatch, tmp_path)
    with database.using({"x": one.entry()}, "arm0/reads"):
        yield one
    one.close()


def opened(port, count=2, mode=Mode.RW, **how):
    if Mode.WRITE in mode:
        how = {"safe": None, **how}
    return open_device("x", port, port + count - 1, mode=mode, **how)


PROGRAM = """
import sys, msgspec
from pbonet.io.drivers import Entry, Mode, database, open_device
entry = msgspec.json.decode(sys.argv[1], type=Entry)
with database.using({"x": entry}, "arm0/moves"):
    torque = open_device("x", 0, 1, mode=Mode.WRITE, safe=[0, 0])
    torque.write([1, 1])
    print("ready", flush=True)
    sys.stdin.readline()
"""


def test_a_process_that_is_killed_leaves_its_servos_limp(rig):
    text = msgspec.json.encode(rig.entry()).decode()
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, text],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "ready\n"
        wait_for(lambda: all(rig.servos.memory[k][64] for k in (1, 7)), "torque")
        process.kill()
        process.wait()
        wait_for(lambda: not listed({"x": rig.entry()})[0].users, "the ports free")
    wait_for(lambda: [rig.servos.memory[k][64] for k in (1, 7)] == [0, 0], "no torque")


def test_servos_are_limp_also_where_another_one_is_missing(rig):
    """So a guard makes safe what is left of a line."""
    rig.servos.memory[1][64] = rig.servos.memory[7][64] = 1
    some = rig.entry(servos=[1, 3, 7], timeout=0.05)
    with database.using({"x": some}), pytest.raises(DeviceError, match="of servo 3"):
        opened(0, 3, mode=Mode.WRITE, safe=[0, 0, 0])
    wait_for(lambda: [rig.servos.memory[k][64] for k in (1, 7)] == [0, 0], "no torque")


def test_packets_are_those_of_the_published_examples():
    """Ping of servo 1, write 512 to address 116 of servo 1, reboot of servo 1."""
    ping = "ff ff fd 00 01 03 00 01 19 4e"
    write = "ff ff fd 00 01 09 00 03 74 00 00 02 00 00 ca 89"
    assert packet(1, 1, b"").hex(" ") == ping
    assert packet(1, 3, bytes.fromhex("74 00 00 02 00 00")).hex(" ") == write
    assert packet(1, 8, b"").hex(" ") == "ff ff fd 00 01 03 00 08 2f 4e"


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
def test_a_register_of_all_servos_is_read_and_written(rig, wait):
    """A value with the bytes that begin a packet passes, too."""
    values = [-1, 0x00FDFFFF]
    with (
        opened(GOAL, wait=wait, mode=Mode.WRITE) as goal,
        opened(POSITION, wait=wait, mode=Mode.READ, signed=True) as position,
    ):
        assert [goal.status("PORTSIZE", k) for k in (0, 2)] == [8, 32]
        goal.write(values)
        for servo, value in zip((1, 7), values, strict=True):
            sent = value.to_bytes(4, "little", signed=True)
            wait_for(lambda s=servo, v=sent: rig.servos.memory[s][116:120] == v, "it")
            rig.servos.memory[servo][132:136] = sent
        assert wait_for(position.read, "the positions") == values
    assert rig.servos.asked.count(0x83) == 1


def test_ports_of_several_registers_are_read_together(rig):
    rig.servos.memory[7][64] = 1
    rig.servos.memory[1][116:120] = b"\1\2\0\0"
    rig.servos.memory[1][132:136] = b"\3\0\0\0"
    with opened(1, 4) as some:
        assert some.read() == [1, 0x201, 0, 3]
        some.write([0, 5, 6, 7])
        assert some.read() == [0, 5, 6, 7]
    assert rig.servos.asked == [1, 1, *[0x82] * 3, *[0x83] * 3, *[0x82] * 3]


@pytest.mark.parametrize("before", [b"", b"\xff\xff\xfd\0\1\7\0\x55", b"\xff" * 5000])
def test_what_is_no_status_is_dropped(rig, before):
    rig.servos.before = before
    rig.servos.memory[7][132] = 9
    with opened(POSITION, mode=Mode.READ) as position:
        assert position.read() == [0, 9]


def test_a_servo_that_is_missing_is_named(rig):
    some = rig.entry(servos=[3, 1, 7], timeout=0.05)
    told = r"does not answer.*got no status of servo"
    with database.using({"x": some}), pytest.raises(DeviceError, match=f"{told} 3"):
        opened(0, 2)
    for wait in (Wait.ALL, Wait.NONE):
        with opened(POSITION, mode=Mode.READ, wait=wait) as position:
            kept = rig.servos.memory.pop(7)
            position._line.timeout = 0.05
            with pytest.raises(DeviceError, match=told):
                wait_for(position.read, "an error")
            rig.servos.memory[7] = kept
            position._line.timeout = 30.0

            def values(device=position):
                with contextlib.suppress(DeviceError):
                    return device.read()

            assert wait_for(values, "values") == [0, 0], "it is open"


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (0x80, "a servo reports an error of its hardware"),
        (0x84, "REBOOT"),
        (0x07, r"such as with torque on \(error 7\)"),
        (0x05, "check registers in agent.toml"),
    ],
)
def test_what_a_servo_reports_is_raised_and_the_line_works_on(rig, error, told):
    with opened(POSITION) as position:
        rig.servos.errors[7] = error
        with pytest.raises(DeviceError, match=told) as caught:
            position.read()
        assert "servo 7" in str(caught.value)
        position.control("REBOOT", 1)
        assert position.read() == [0, 0]
        with pytest.raises(DeviceError, match="no command RESET"):
            position.control("RESET", 1)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"servos": []}, "servos"),
        ({"servos": [253]}, "servos"),
        ({"registers": [[132, 3]]}, "registers"),
        ({"registers": [[132, 4]]}, "expected 0 to 1, got 0 to 2"),
        ({"timeout": 0}, "timeout"),
    ],
)
def test_wrong_settings_are_refused(rig, settings, told):
    with database.using({"x": rig.entry(**settings)}), pytest.raises(DeviceError) as e:
        opened(0, 3)
    assert told in str(e.value)


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
@pytest.mark.parametrize(
    "garbage", [b"\x55", b"\xff\xff\xfd\0", b"\xff\xff\xfd\0\1\4\0"]
)
def test_a_line_full_of_garbage_ends_in_an_error(rig, wait, garbage):
    """All of it is sent, as fast as the device takes it, and nothing hangs."""
    position = opened(POSITION, mode=Mode.READ, wait=wait)
    position._line.timeout = 0.05
    rig.servos.silence()
    many = [garbage * (100_000 // len(garbage))]
    os.set_blocking(rig.servos.fd, False)

    def send():
        with contextlib.suppress(BlockingIOError):
            many[0] = many[0][os.write(rig.servos.fd, many[0]) :]

    errors = []
    with position:
        while many[0]:
            send()
            try:
                assert position.read() == []
            except DeviceError as error:
                errors.append(error.what)
        with pytest.raises(DeviceError, match="does not answer"):
            wait_for(position.read, "an error")
    assert set(errors) <= {"the device does not answer"}
